"""Draws gathering.png: particles in a slice of the box after a turnover, of the truth and of variants of the ladder.

    .venv/bin/python docs/gathering.py runs/ladder paper=published horizons-24=repaired local resolved
"""

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI
from pictures import save

from eddies.analysis.disorder import count_variance
from eddies.io.hdf5 import open_product
from eddies.io.trajectories import Trajectory
from eddies.report.figures import SIGNED, panels, styled

SEED, THICK = 3, 0.125  # the flow, and the thickness of the slice over the edge of the box: a filter width


def particles(path: Path, kind: str, name: str, time: float | None = None):
    """Time since the release, edge of the box, positions and velocities of the last frame, or of that nearest to a
    time."""
    with open_product(MPI.COMM_SELF, path, kind) as file:
        rows = Trajectory(file, name)
        times = rows.times + (file["rollout"].attrs["start_time"] if kind == "rollout" else 0.0)
        frame = len(times) - 1 if time is None else int(np.argmin(np.abs(times - time)))
        return float(times[frame]), rows.length, rows.read(frame, "position"), rows.read(frame, "velocity")


@styled
def figure(run: Path, variants: dict[str, str]):
    """Particles in the slice, coloured by u_x; the titles have the variance of counts over that of random points."""
    found = {label: particles(run / name / f"realisation-{SEED}" / "rollout.h5", "rollout", "model")
             for name, label in variants.items()}
    time = next(iter(found.values()))[0]
    truth = particles(run / f"realisation-{SEED}" / "ground_truth.h5", "ground_truth", "tracers", time)
    shown = {"truth": truth} | found
    drawn, axes = panels(1, len(shown), (2.4, 2.65), sharey=True)
    for axis, (label, (_, length, position, velocity)) in zip(axes[0], shown.items()):
        inside = np.abs(position[:, 2] - length / 2) < THICK * length / 2
        axis.scatter(*position[inside, :2].T, c=velocity[inside, 0], s=11, cmap=SIGNED, vmin=-2.2, vmax=2.2,
                     edgecolors="0.25", linewidths=0.45)
        axis.spines[:].set_visible(True)
        axis.set(title=f"{label}: {count_variance(position, length):.1f}", xlim=(0, length), ylim=(0, length), aspect=1,
                 xticks=[], yticks=[])
    drawn.subplots_adjust(left=0.01, right=0.99, bottom=0.02, top=0.9, wspace=0.06)
    return drawn


if __name__ == "__main__":
    save(Path(__file__).parent / "gathering.png", figure(Path(sys.argv[1]), {
        name: label or name for name, _, label in (word.partition("=") for word in sys.argv[2:])}))
