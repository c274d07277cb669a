#!/usr/bin/env bash
# Sets up what is missing and runs a scene on the cores of this machine:
#   bash jobs/local.sh [SCENE] [options of `eddies run`]        default scene: hit-small
# EDDIES_RANKS limits the number of ranks (default: 8, or the cores where there are fewer; a slab of a small scene
# must not be thinner than its halo).
set -euo pipefail
jobs=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
bash "$jobs/../mpi_tools/bootstrap.sh"
EDDIES_SCENE=hit-small
if [ $# -gt 0 ] && [ "${1#-}" = "$1" ]; then
    EDDIES_SCENE=$1
    shift
fi
export EDDIES_RANKS=${EDDIES_RANKS:-8}
launcher=("$jobs/../.venv/bin/python" "$jobs/../mpi_tools/launch.py" --)
resubmit=(true)
source "$jobs/run.sh"
