"""Keeps the trained weights of a run with the package, without what only their report shows.

    .venv/bin/python docs/weights.py runs/hit-small/paper hit-small-paper    # src/eddies/weights/hit-small-paper.h5
"""

import sys
from pathlib import Path

from mpi4py import MPI

from eddies.io.weights import load_weights, save_weights
from eddies.scene.model import WEIGHTS

KEPT = ("a_priori", "feature_range")  # tables: errors on their own flow, and the range of what a network was given


def keep(run: Path, name: str) -> Path:
    """Write the file of the package; returns its path."""
    stored = load_weights(MPI.COMM_SELF, run / "model.h5", "model")
    tables = {title: table for title, table in stored.tables.items() if title in KEPT}
    target = WEIGHTS / f"{name}.h5"
    save_weights(MPI.COMM_SELF, target, "model", stored.description, stored.weights, stored.provenance, tables)
    return target


if __name__ == "__main__":
    print(keep(Path(sys.argv[1]), sys.argv[2]))
