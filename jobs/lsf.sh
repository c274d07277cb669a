#!/usr/bin/env bash
# EDDIES_SCENE=hit-small bsub < jobs/lsf.sh
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#BSUB -J eddies
#BSUB -n 8
# For T threads per rank: core(T), and OMP_NUM_THREADS=T in the environment of bsub.
#BSUB -R "affinity[core(1)]"
#BSUB -W 4:00
#BSUB -o eddies.%J.log
# SIGUSR1 five minutes before the limit: the ranks end with 75, which queues the job again.
#BSUB -wa USR1
#BSUB -wt 5
#BSUB -Q 75
launcher=(mpirun --map-by "slot:PE=${OMP_NUM_THREADS:-1}")
resubmit=(true)

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
body=${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh
if [ ! -e "$body" ]; then echo "no $body: submit from the checkout, or set EDDIES_CHECKOUT to it" >&2; exit 2; fi
source "$body"
