#!/usr/bin/env bash
# Sets up what is missing and runs a scene on the cores of this machine:
#   bash jobs/local.sh [SCENE] [options of `eddies run`]        default scene: hit-small
# EDDIES_RANKS limits the number of ranks. The default is the least of 8, the cores, and the ranks that the scene can use.
set -euo pipefail
jobs=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
bash "$jobs/../mpi_tools/bootstrap.sh"
EDDIES_SCENE=hit-small
if [ $# -gt 0 ] && [ "${1#-}" = "$1" ]; then
    EDDIES_SCENE=$1
    shift
fi
if [ -z "${EDDIES_RANKS:-}" ]; then
    numbers=$("$jobs/../.venv/bin/eddies" check "$EDDIES_SCENE" --json)
    most=$("$jobs/../.venv/bin/python" -c 'import json, sys; print(json.load(sys.stdin)["most_ranks"])' <<< "$numbers")
    EDDIES_RANKS=$((most < 8 ? most : 8))
fi
export EDDIES_RANKS
launcher=("$jobs/../.venv/bin/python" "$jobs/../mpi_tools/launch.py" --)
resubmit=(true)
source "$jobs/run.sh"
