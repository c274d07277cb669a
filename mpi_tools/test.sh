#!/usr/bin/env bash
# Sets up what is missing and runs the tests. Arguments go to pytest: bash mpi_tools/test.sh tests/parallel -k halo
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash mpi_tools/bootstrap.sh
# One thread, as under mpirun. Otherwise torch starts a thread on every core, beside the ranks of a test.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
# Compiled modules are stored. Otherwise each of the hundreds of processes of the tests would compile them again.
unset PYTHONDONTWRITEBYTECODE
exec .venv/bin/python -m pytest "$@"
