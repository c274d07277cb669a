"""Draws rollout.png: u_x in the plane z = pi over time, of the true tracers and of variants of a run.

    .venv/bin/python docs/rollout.py runs/hit-small paper resolved
"""

import io
import sys
from contextlib import ExitStack
from pathlib import Path

from mpi4py import MPI
from PIL import Image

from eddies.report.figures import png
from eddies.report.rollout_figures import velocity_planes
from eddies.workflows.rollout.measured import open_rollout

SHOWN = 4  # times
COLOURS, WIDTH = 128, 1100  # of the picture


def picture(run: Path, variants: list[str]) -> bytes:
    """The image; times are spread over the rollout of the first variant."""
    with ExitStack() as files:
        rollouts = {name: files.enter_context(open_rollout(run / name, MPI.COMM_SELF)).rollout for name in variants}
        first = rollouts[variants[0]]
        shown = first.common.spread(SHOWN)
        rows = {"true tracers": [first.both(first.planes, index)[1] for index in shown]}
        rows |= {name: [each.both(each.planes, index)[0] for index in shown] for name, each in rollouts.items()}
        return png(velocity_planes(rows, first.common.times[list(shown)] / first.turnover))


if __name__ == "__main__":
    image = Image.open(io.BytesIO(picture(Path(sys.argv[1]), sys.argv[2:]))).convert("RGB")
    image.thumbnail((WIDTH, WIDTH))
    image.quantize(COLOURS).save(Path(__file__).parent / "rollout.png", optimize=True)
