# Body of every job: runs a scene and continues after the stages that an earlier job finished. The other scripts source
# it; they set the arrays
#   launcher  the command that starts the ranks
#   resubmit  the command that queues this job again on exit code 75, or true
# Read from the environment of the job:
#   EDDIES_SCENE     built-in name or path (default: hit-small)
#   EDDIES_STAGE     stage to run, such as dns (default: run, all stages)
#   EDDIES_OUTPUT    run directory (default: runs/NAME)
#   OMP_NUM_THREADS  threads per rank (default: the CPUs that Slurm gives a rank, or 1)
# Arguments go to the command: --set section.key=value and the like.

checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-${SLURM_CPUS_PER_TASK:-1}}
arguments=("${EDDIES_STAGE:-run}" "${EDDIES_SCENE:-hit-small}")
if [ -n "${EDDIES_OUTPUT:-}" ]; then arguments+=(--output "$EDDIES_OUTPUT"); fi

trap : USR1  # some schedulers signal this shell too; it waits for the ranks, which end with 75
status=0
"${launcher[@]}" "$checkout/.venv/bin/eddies" "${arguments[@]}" "$@" || status=$?
if [ "$status" -eq 138 ]; then status=75; fi  # SIGUSR1 came before the ranks could catch it
if [ "$status" -eq 75 ]; then
    echo "stopped before the time limit: the same command continues"
    "${resubmit[@]}" || echo "could not queue the job again, do it by hand: ${resubmit[*]}" >&2
fi
exit "$status"
