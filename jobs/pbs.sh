#!/usr/bin/env bash
# qsub -v EDDIES_SCENE=hit-small jobs/pbs.sh
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#PBS -N eddies
# For T threads per rank: ncpus=8T, ompthreads=T.
#PBS -l select=1:ncpus=8:mpiprocs=8:ompthreads=1
#PBS -l walltime=04:00:00
#PBS -j oe
# PBS cannot warn a job: timeout sends SIGUSR1 to mpirun, which forwards it, five minutes before the walltime.
launcher=(timeout --preserve-status --signal=USR1 235m mpirun --map-by "slot:PE=${OMP_NUM_THREADS:-1}")
resubmit=(qsub -V jobs/pbs.sh)

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
body=${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh
if [ ! -e "$body" ]; then echo "no $body: submit from the checkout, or set EDDIES_CHECKOUT to it" >&2; exit 2; fi
source "$body"
