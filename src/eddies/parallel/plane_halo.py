"""Ghost planes: copies of the grid planes just below and above a slab."""

from __future__ import annotations

from collections.abc import Sequence

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

    def forward(self, planes: np.ndarray) -> list[np.ndarray]:
        """Planes (c, z_local, ...) -> parts that follow each other, (c, below, ...), the planes, (c, above, ...)."""
        slab, count = self.decomposition, planes.shape[1]
        lowest, highest = planes[:, : self.above], planes[:, count - self.below :]
        if slab.size == 1:
            return [highest, planes, lowest]
        from_below, from_above = np.empty(highest.shape, planes.dtype), np.empty(lowest.shape, planes.dtype)
        self._exchange(lowest, slab.below, from_above, slab.above)
        self._exchange(highest, slab.above, from_below, slab.below)
        return [from_below, planes, from_above]

    def parts(self, planes: np.ndarray) -> list[np.ndarray]:
        """The parts of (c, z_local, ...) with ghost planes of nothing, for `adjoint`."""
        below, above = (np.zeros((len(planes), count, *planes.shape[2:]), planes.dtype)
                        for count in (self.below, self.above))
        return [below, planes, above]

    def adjoint(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Transpose of `forward`: ghost planes added at home, to the planes (c, z_local, ...) themselves."""
        highest, planes, lowest = parts
        slab, count = self.decomposition, planes.shape[1]
        if slab.size > 1:
            from_below, from_above = np.empty(lowest.shape, lowest.dtype), np.empty(highest.shape, highest.dtype)
            self._exchange(lowest, slab.above, from_below, slab.below)
            self._exchange(highest, slab.below, from_above, slab.above)
            lowest, highest = from_below, from_above
        planes[:, : self.above] += lowest
        planes[:, count - self.below :] += highest
        return planes

    def _exchange(self, sent: np.ndarray, destination: int, received: np.ndarray, source: int) -> None:
        self.decomposition.comm.Sendrecv(
            [np.ascontiguousarray(sent), MPI.BYTE], destination, recvbuf=[received, MPI.BYTE], source=source
        )
