"""Slab decomposition: grid planes and particles are distributed over ranks by the same rule."""

import numpy as np
from mpi4py import MPI


def block_starts(total: int, parts: int) -> np.ndarray:
    """Return the first index of each of `parts` consecutive blocks of `total` items, then `total`: (parts + 1,).

    The first `total % parts` blocks hold one item more than the others.
    """
    sizes = np.full(parts, total // parts)
    sizes[: total % parts] += 1
    return np.concatenate([[0], np.cumsum(sizes)])


class SlabDecomposition:
    """Slabs of a periodic cube of side `length`, cut along z into blocks of `planes` equal layers.

    A particle is on the rank that owns the grid plane just below it. This rank owns the `count` planes start, ...,
    stop - 1, and the particles with z from `lower` to `upper`. `below` and `above` are the neighbouring ranks.
    """

    def __init__(self, comm: MPI.Comm, length: float, planes: int) -> None:
        self.comm, self.rank, self.size = comm, comm.rank, comm.size
        self.length, self.planes = float(length), int(planes)
        self.spacing = self.length / self.planes
        self.starts = block_starts(self.planes, self.size)
        self.start, self.stop = int(self.starts[self.rank]), int(self.starts[self.rank + 1])
        self.count = self.stop - self.start
        self.lower, self.upper = self.start * self.spacing, self.stop * self.spacing
        self.below, self.above = (self.rank - 1) % self.size, (self.rank + 1) % self.size
        self._owner = np.repeat(np.arange(self.size), np.diff(self.starts))

    def owner_of(self, z: np.ndarray) -> np.ndarray:
        """Return the rank that owns each coordinate `z` in [0, length)."""
        plane = np.floor(np.asarray(z) / self.spacing).astype(np.int64)
        # z just below `length` may round up to a plane that does not exist.
        return self._owner[np.clip(plane, 0, self.planes - 1)]
