#!/usr/bin/env bash
# EDDIES_SCENE=hit-small sbatch jobs/slurm.sh [options of `eddies run`]
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#SBATCH --job-name=eddies
#SBATCH --nodes=1
#SBATCH --ntasks-per-node=8
# Threads per rank:
#SBATCH --cpus-per-task=1
#SBATCH --time=04:00:00
# SIGUSR1 to the ranks five minutes before the limit: they end with 75, and the job is queued again.
#SBATCH --signal=USR1@300
#SBATCH --requeue
#SBATCH --open-mode=append
# Exports the environment of sbatch with its modules; to set a variable: --export=ALL,EDDIES_SCENE=hit
#SBATCH --export=ALL
# If your cluster requires these, write them with a single #:
##SBATCH --account=NAME
##SBATCH --partition=NAME
# SLURM_MPI_TYPE sets how srun connects the ranks; `srun --mpi=list` lists its values.
launcher=(srun --mpi="${SLURM_MPI_TYPE:-pmix}" --export=ALL --cpus-per-task="${SLURM_CPUS_PER_TASK:-1}")
resubmit=(scontrol requeue "${SLURM_JOB_ID:-}")

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
body=${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh
if [ ! -e "$body" ]; then echo "no $body: submit from the checkout, or set EDDIES_CHECKOUT to it" >&2; exit 2; fi
source "$body"
