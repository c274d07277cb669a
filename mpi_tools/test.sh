#!/usr/bin/env bash
# Sets up what is missing and runs the tests; arguments go to pytest: bash mpi_tools/test.sh tests/parallel -k halo
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash mpi_tools/bootstrap.sh
# As under mpirun: without it torch starts a thread for each core beside the ranks of a test.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
# The modules are compiled once, not by each of the hundreds of processes that the tests start.
unset PYTHONDONTWRITEBYTECODE
exec .venv/bin/python -m pytest "$@"
