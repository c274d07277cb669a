"""Ghost planes: copies of the grid planes just below and above a slab."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from eddies.parallel.halo import HaloError
from eddies.parallel.slab import SlabDecomposition


class PlaneHalo:
    """Adds `below` and `above` planes of the neighbouring slabs, periodically, around this rank's planes.

    Raises HaloError if a slab has fewer planes than either number. One rank copies its own planes and sends nothing.
    """

    def __init__(self, decomposition: SlabDecomposition, below: int, above: int) -> None:
        self.decomposition, self.below, self.above = decomposition, below, above
        needed = max(below, above)
        if decomposition.thinnest() < needed:
            raise HaloError(
                f"{decomposition.size} ranks make slabs of {decomposition.thinnest()} grid planes, fewer than "
                f"the {needed} ghost planes of the interpolation; use at most "
                f"{max(decomposition.planes // needed, 1)} ranks"
            )

    def forward(self, planes: np.ndarray) -> np.ndarray:
        """(z_local, ...) -> (below + z_local + above, ...)."""
        count = len(planes)
        padded = np.empty((self.below + count + self.above, *planes.shape[1:]), planes.dtype)
        padded[self.below : self.below + count] = planes
        lowest, highest = planes[: self.above], planes[count - self.below :]
        if self.decomposition.size == 1:
            padded[: self.below], padded[self.below + count :] = highest, lowest
        else:
            slab = self.decomposition
            self._exchange(lowest, slab.below, padded[self.below + count :], slab.above)
            self._exchange(highest, slab.above, padded[: self.below], slab.below)
        return padded

    def adjoint(self, padded: np.ndarray) -> np.ndarray:
        """Transpose of `forward`: ghost planes added at home, (below + z_local + above, ...) -> (z_local, ...)."""
        slab, count = self.decomposition, len(padded) - self.below - self.above
        planes = padded[self.below : self.below + count].copy()
        lowest, highest = padded[self.below + count :], padded[: self.below]
        if slab.size > 1:
            received = np.empty(lowest.shape, padded.dtype), np.empty(highest.shape, padded.dtype)
            self._exchange(lowest, slab.above, received[0], slab.below)
            self._exchange(highest, slab.below, received[1], slab.above)
            lowest, highest = received
        planes[: self.above] += lowest
        planes[count - self.below :] += highest
        return planes

    def _exchange(self, sent: np.ndarray, destination: int, received: np.ndarray, source: int) -> None:
        self.decomposition.comm.Sendrecv(
            [np.ascontiguousarray(sent), MPI.BYTE], destination, recvbuf=[received, MPI.BYTE], source=source
        )
