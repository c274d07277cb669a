"""Draws rollout.png: u_x in the plane z = pi over time, of the true tracers and of variants of a run.

    .venv/bin/python docs/rollout.py runs/hit-small paper resolved
"""

import sys
from contextlib import ExitStack
from pathlib import Path

from mpi4py import MPI
from paper import figure_4, save

from eddies.workflows.rollout.measured import open_rollout


def main(run: Path, variants: list[str]) -> None:
    """Draw the picture; times are spread over the rollout of the first variant."""
    with ExitStack() as files:
        rollouts = {name: files.enter_context(open_rollout(run / name, MPI.COMM_SELF)).rollout for name in variants}
        save(Path(__file__).parent / "rollout.png", figure_4(rollouts))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2:])
