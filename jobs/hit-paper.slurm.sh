#!/usr/bin/env bash
# sbatch jobs/hit-paper.slurm.sh [options of `eddies dns`]
# Ground truth of the scene hit-paper: 1024^3 cells on 256 ranks, 64 on each of four nodes, about 84 GB of memory per
# node. Time a hundred steps first (docs/clusters.md). A job that reaches its time limit is queued again and continues.
# The later stages use at most 22 ranks. Submit them afterwards:
#   EDDIES_SCENE=hit-paper sbatch --ntasks-per-node=22 jobs/slurm.sh
# Submit from the checkout, or set EDDIES_CHECKOUT to it. Load your cluster's modules first, as for set-up.
#SBATCH --job-name=hit-paper
#SBATCH --nodes=4
#SBATCH --ntasks-per-node=64
#SBATCH --cpus-per-task=1
#SBATCH --mem=120G
#SBATCH --time=24:00:00
# SIGUSR1 to the ranks five minutes before the limit: they end with 75, and the job is queued again.
#SBATCH --signal=USR1@300
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --export=ALL
##SBATCH --account=NAME
##SBATCH --partition=NAME
EDDIES_SCENE=hit-paper EDDIES_STAGE=dns  # `run` would run all stages
launcher=(srun --mpi="${SLURM_MPI_TYPE:-pmix}" --export=ALL --cpus-per-task="${SLURM_CPUS_PER_TASK:-1}")
resubmit=(scontrol requeue "${SLURM_JOB_ID:-}")

# ---- the same for every scheduler
set -euo pipefail
cd "${PBS_O_WORKDIR:-$PWD}"
body=${EDDIES_CHECKOUT:-$PWD}/jobs/run.sh
if [ ! -e "$body" ]; then echo "no $body: submit from the checkout, or set EDDIES_CHECKOUT to it" >&2; exit 2; fi
source "$body"
