"""Draws rollout.png: u_x in the plane z = pi over time, of the true tracers and of variants of a run.

    .venv/bin/python docs/rollout.py runs/hit-small paper resolved
"""

import io
import sys
from pathlib import Path

from mpi4py import MPI
from PIL import Image

from eddies.report.figures import BAR, SIGNED, colour_bar, largest, panels, png, show_plane, styled
from eddies.workflows.rollout.measured import open_rollout

SHOWN = 4  # times


@styled
def picture(run: Path, variants: list[str]) -> bytes:
    """The image; times are spread over the rollout of the first variant."""
    rows, times = {}, None
    for variant in variants:
        with open_rollout(run / variant, MPI.COMM_SELF) as measured:
            rollout = measured.rollout
            shown = rollout.common.spread(SHOWN)
            model, truth = zip(*(rollout.both(rollout.planes, index) for index in shown))
            if times is None:
                times = rollout.common.times[list(shown)] / rollout.turnover
                rows["true tracers"] = [one.velocity[0] for one in truth]
            rows[variant] = [one.velocity[0] for one in model]
    figure, axes = panels(len(rows), SHOWN, (2.1, 2.0), right=BAR, sharex=True, sharey=True)
    limit = largest(*rows["true tracers"])
    for row, (name, planes) in zip(axes, rows.items()):
        for axis, plane in zip(row, planes):
            image = show_plane(axis, plane, (-limit, limit), SIGNED)
        row[0].set_ylabel(f"{name}\n$y$")
    for axis, time in zip(axes[0], times):
        axis.set_title(f"$t = {time:.2f}\\,T$")
    for axis in axes[-1]:
        axis.set_xlabel("$x$")
    colour_bar(figure, image, axes.flat, "$u_x$")
    return png(figure)


if __name__ == "__main__":
    image = Image.open(io.BytesIO(picture(Path(sys.argv[1]), sys.argv[2:]))).convert("RGB")
    image.quantize(160).save(Path(__file__).parent / "rollout.png", optimize=True)  # a third of the size
