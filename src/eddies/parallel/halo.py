"""Ghost particles: copies of the particles within a given width of a slab's faces, and the adjoint of copying."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from eddies.errors import UserError
from eddies.parallel.slab import SlabDecomposition


class HaloError(UserError, ValueError):
    """A slab is thinner than the halo."""


class HaloExchange:
    """Copies of the neighbours' particles within `width` of this slab; planned once, applied to any column.

    Parameters
    ----------
    decomposition : slabs
    positions : float array (n, 3), owned particles, z within this rank's slab.
    width : float, how far beyond its faces a rank needs to see.

    Each rank sends the particles near its lower face down and those near its upper face up. The two faces stay
    apart even where both neighbours are the same rank, so a particle can have two images there, told apart by the
    period added to their z. Ghost rows stand in the order: from above, then from below. One rank sends nothing.
    Raises HaloError if a slab is thinner than `width`.
    """

    def __init__(self, decomposition: SlabDecomposition, positions: np.ndarray, width: float) -> None:
        self.decomposition = decomposition
        self.owned = len(positions)
        self.count = 0
        if decomposition.size == 1:
            return
        require_thick_slabs(decomposition, width)
        z = np.asarray(positions)[:, 2]
        self._down = np.flatnonzero(z < decomposition.lower + width)
        self._up = np.flatnonzero(z >= decomposition.upper - width)
        below, above = decomposition.below, decomposition.above
        self._from_above = int(self._exchange(np.array([len(self._down)]), below, above, (1,))[0])
        self._from_below = int(self._exchange(np.array([len(self._up)]), above, below, (1,))[0])
        self.count = self._from_above + self._from_below

    def forward(self, owned: np.ndarray) -> np.ndarray:
        """Ghost rows (count, ...) of a column of owned rows (n, ...)."""
        owned = np.asarray(owned)
        if self.decomposition.size == 1:
            return np.empty((0, *owned.shape[1:]), owned.dtype)
        slab, tail = self.decomposition, owned.shape[1:]
        from_above = self._exchange(owned[self._down], slab.below, slab.above, (self._from_above, *tail))
        from_below = self._exchange(owned[self._up], slab.above, slab.below, (self._from_below, *tail))
        return np.concatenate([from_above, from_below])

    def forward_positions(self, positions: np.ndarray) -> np.ndarray:
        """Ghost positions (count, 3), moved by one period in z where the image lies beyond the periodic face."""
        ghosts = self.forward(positions)
        slab = self.decomposition
        if slab.size > 1 and slab.rank == slab.size - 1:
            ghosts[: self._from_above, 2] += slab.length
        if slab.size > 1 and slab.rank == 0:
            ghosts[self._from_above :, 2] -= slab.length
        return ghosts

    def adjoint(self, ghosts: np.ndarray) -> np.ndarray:
        """Transpose of `forward`: ghost rows (count, ...) sent home and added, per owned row (n, ...).

        For all x, y: sum over ranks of forward(x).y equals the sum over ranks of x.adjoint(y).
        """
        ghosts = np.asarray(ghosts)
        slab, tail = self.decomposition, ghosts.shape[1:]
        owned = np.zeros((self.owned, *tail), ghosts.dtype)
        if slab.size == 1:
            return owned
        down = self._exchange(ghosts[: self._from_above], slab.above, slab.below, (len(self._down), *tail))
        up = self._exchange(ghosts[self._from_above :], slab.below, slab.above, (len(self._up), *tail))
        # Within one face each owned row appears once, so plain indexed addition is exact.
        owned[self._down] += down
        owned[self._up] += up
        return owned

    def _exchange(self, rows: np.ndarray, destination: int, source: int, shape: tuple[int, ...]) -> np.ndarray:
        received = np.empty(shape, rows.dtype)
        self.decomposition.comm.Sendrecv(
            [np.ascontiguousarray(rows), MPI.BYTE], destination, recvbuf=[received, MPI.BYTE], source=source
        )
        return received


def require_thick_slabs(decomposition: SlabDecomposition, width: float) -> None:
    """Raise HaloError, naming the largest usable number of ranks, if a slab is thinner than `width`."""
    needed = int(np.ceil(width / decomposition.spacing - 1e-9))
    if decomposition.size > 1 and decomposition.thinnest() < needed:
        usable = max(decomposition.planes // needed, 1)
        raise HaloError(
            f"{decomposition.size} ranks make slabs of {decomposition.thinnest()} planes, thinner than the halo of "
            f"{needed} planes (width {width:.4g}); use at most {usable} ranks"
        )
