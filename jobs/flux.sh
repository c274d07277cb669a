#!/usr/bin/env bash
# EDDIES_SCENE=hit-small flux batch jobs/flux.sh
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#flux: --job-name=eddies
#flux: --nodes=1
#flux: --nslots=8
# For T threads per rank: T, and OMP_NUM_THREADS=T in the environment of flux.
#flux: --cores-per-slot=1
#flux: --time-limit=4h
# The ranks are a job inside the job: SIGUSR1 reaches them five minutes before its limit.
launcher=(flux run --ntasks=8 --cores-per-task="${OMP_NUM_THREADS:-1}" --time-limit=238m --signal=USR1@5m)
resubmit=(flux --parent batch jobs/flux.sh)

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
body=${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh
if [ ! -e "$body" ]; then echo "no $body: submit from the checkout, or set EDDIES_CHECKOUT to it" >&2; exit 2; fi
source "$body"
