#!/usr/bin/env bash
# Sets up what is missing and runs the tests. Arguments go to pytest: bash mpi_tools/test.sh tests/parallel -k halo
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash mpi_tools/bootstrap.sh
# As under mpirun: otherwise torch starts a thread per core beside the ranks of a test.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
# Modules are compiled once, not by each of the hundreds of processes that the tests start.
unset PYTHONDONTWRITEBYTECODE
exec .venv/bin/python -m pytest "$@"
