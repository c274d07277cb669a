#!/usr/bin/env bash
# Sets up what is missing and runs the tests: those without MPI beside those on one rank, then those on two and on three.
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
# The tests send signals to jobs, which would inherit that they are ignored: in the background, or under nohup.
env --default-signal=INT,HUP .venv/bin/python -m pytest "$@" > "$log" 2>&1 &
unmarked=$!
trap 'kill $unmarked 2> /dev/null || true; rm "$log"' EXIT
for ranks in 1 2 3; do
    echo "tests on $ranks rank(s)"
    .venv/bin/python mpi_tools/launch.py -n $ranks -- .venv/bin/python -m pytest --color=no -m mpi "$@" || failed=1
    if [ $ranks -eq 1 ]; then
        wait $unmarked || [ $? -eq 5 ] || failed=1  # 5: no tests are selected
        echo "tests without MPI"
        cat "$log"
    fi
done
exit $failed
