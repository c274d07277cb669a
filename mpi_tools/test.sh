#!/usr/bin/env bash
# Sets up what is missing and runs the tests: those on one and on two ranks, beside those without MPI and on three.
# Arguments go to each pytest: bash mpi_tools/test.sh tests/parallel -k halo
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
bash mpi_tools/bootstrap.sh
# One thread, as under mpirun. Otherwise torch starts a thread on every core, beside the ranks of a test.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
# A rank that waits yields its core.
export OMPI_MCA_mpi_yield_when_idle=1
# Ranks of one machine need no network, for which Open MPI would search at each start, and single ones no daemon.
export OMPI_MCA_pml=${OMPI_MCA_pml:-ob1} OMPI_MCA_ess_singleton_isolated=1
# Compiled modules are stored. Otherwise each of the hundreds of processes of the tests would compile them again.
unset PYTHONDONTWRITEBYTECODE
failed=0
log=$(mktemp)

# The tests on a number of ranks.
on_ranks() {
    echo "tests on $1 rank(s)"
    .venv/bin/python mpi_tools/launch.py -n "$1" -- .venv/bin/python -m pytest --color=no -m mpi "${@:2}"
}

# The tests without MPI, then those on three ranks, which are few.
beside() {
    local failed=0
    echo "tests without MPI"
    # The tests send signals to jobs, which would inherit that they are ignored: in the background, or under nohup.
    env --default-signal=INT,HUP .venv/bin/python -m pytest "$@" || [ $? -eq 5 ] || failed=1  # 5: none is selected
    on_ranks 3 "$@" || failed=1
    return $failed
}

set -m  # a process group for the background
beside "$@" > "$log" 2>&1 &
others=$!
trap 'kill -- -$others 2> /dev/null || true; rm "$log"' EXIT
on_ranks 1 "$@" || failed=1
on_ranks 2 "$@" || failed=1
wait $others || failed=1
cat "$log"
exit $failed
