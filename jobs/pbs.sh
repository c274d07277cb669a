#!/usr/bin/env bash
# qsub -v EDDIES_SCENE=hit-small jobs/pbs.sh
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#PBS -N eddies
#PBS -l select=1:ncpus=8:mpiprocs=8:ompthreads=1
#PBS -l walltime=04:00:00
#PBS -j oe
# PBS cannot warn a job: timeout sends SIGUSR1 to mpirun, and so to the ranks, five minutes before the walltime.
launcher=(timeout --preserve-status --signal=USR1 235m mpirun)
resubmit=(qsub -V jobs/pbs.sh)

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
source "${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh"
