"""All neighbours of random points in a periodic box, both orders of each pair: by the compiled list and by vesin, at
the same points and in one run.

    OMP_NUM_THREADS=1 .venv/bin/python tests/benchmarks/neighbors.py [POINTS A SIDE] [--neighbors N]

vesin (pip install --no-binary vesin vesin) gives the two numbers of each pair, in no order, in memory of its own; ours
come in compressed rows. All are in double precision and on one thread. Prints a JSON line with medians of seconds.
"""

import argparse
import json
import math
from collections.abc import Callable
from importlib.metadata import version

import numpy as np
import torch
import vesin
from step import in_turn

from eddies.particles.neighborhood import NeighborList
from eddies.particles.periodic_box import PeriodicBox

LENGTH = 2 * math.pi


def rows(points: torch.Tensor, cutoff: float) -> tuple[np.ndarray, np.ndarray]:
    """Compressed rows."""
    found = NeighborList(PeriodicBox(LENGTH, True), cutoff, 0.0)
    found.build(points, points, exclude_self=True)
    return found.offsets.numpy(), found.senders.numpy()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("side", nargs="?", type=int, default=64)
    parser.add_argument("--neighbors", type=float, default=60.0)
    options = parser.parse_args()
    torch.set_num_threads(1)
    position = np.random.default_rng(1).uniform(0, LENGTH, (options.side**3, 3))
    points, box = torch.from_numpy(position), LENGTH * np.eye(3)
    cutoff = LENGTH / options.side * (options.neighbors * 3 / (4 * math.pi)) ** (1 / 3)
    peer = vesin.NeighborList(cutoff=cutoff, full_list=True, n_threads=1)

    actions: dict[str, Callable[[], tuple[np.ndarray, np.ndarray]]] = {
        "eddies": lambda: rows(points, cutoff),
        "vesin": lambda: peer.compute(position, box, True, "ij", copy=False)}
    offsets, senders = actions["eddies"]()
    ours = np.sort(np.repeat(np.arange(len(position)), np.diff(offsets)) * len(position) + senders)
    first, second = (index.astype(np.int64) for index in actions["vesin"]())
    if not np.array_equal(ours, np.sort(first * len(position) + second)):
        raise SystemExit("neighbors: the lists differ")
    middle = in_turn(actions)
    print(json.dumps({"points": options.side, "neighbors": len(senders) / len(position), "vesin": version("vesin"),
                      "seconds": middle, "nanoseconds_per_pair": 1e9 * middle["eddies"] / len(senders),
                      "ratio": {"vesin": middle["vesin"] / middle["eddies"]}}))


if __name__ == "__main__":
    main()
