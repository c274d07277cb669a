"""Halos: copies of the particles or grid planes just outside a slab, and the adjoint of copying."""

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI

from eddies.clock import rounded_up
from eddies.errors import UserError
from eddies.parallel.slab import SlabDecomposition


class HaloError(UserError, ValueError):
    """A slab is thinner than the halo, or a particle is not finite or farther outside its slab than ghosts allow."""


class HaloExchange:
    """Exchange of ghosts: the neighbouring ranks' particles within `width` of this slab. Any column can be exchanged.

    Parameters
    ----------
    decomposition : the slabs of all ranks.
    positions : (n, 3), the positions of this rank's own particles, whose z lies in this rank's slab.
    width : a rank needs the particles up to this distance beyond the faces of its slab.

    Each rank sends the particles near its lower face down and those near its upper face up. The two exchanges stay
    separate even if both neighbours are the same rank: a particle then may have two images, which differ in z by a
    period. Of the `count` ghost rows, those from above come first, then those from below. With a single rank there are
    no ghosts, and the methods must not be called. Raises HaloError if a slab is thinner than `width`.
    """

    def __init__(self, decomposition: SlabDecomposition, positions: np.ndarray, width: float) -> None:
        self.decomposition, self.owned, self.count = decomposition, len(positions), 0
        if decomposition.size == 1:
            return
        require_thick_slabs(decomposition, width)
        z = np.asarray(positions)[:, 2]
        self._down = np.flatnonzero(z < decomposition.lower + width)
        self._up = np.flatnonzero(z >= decomposition.upper - width)
        below, above = decomposition.below, decomposition.above
        self._from_above = int(_exchange(decomposition, np.array([len(self._down)]), below, above, (1,))[0])
        self._from_below = int(_exchange(decomposition, np.array([len(self._up)]), above, below, (1,))[0])
        self.count = self._from_above + self._from_below

    def forward(self, owned: np.ndarray) -> np.ndarray:
        """Return the ghost rows (count, ...) of a column; `owned` (n, ...) are its rows on this rank."""
        owned = np.asarray(owned)
        slab, tail = self.decomposition, owned.shape[1:]
        return np.concatenate([
            _exchange(slab, owned[self._down], slab.below, slab.above, (self._from_above, *tail)),
            _exchange(slab, owned[self._up], slab.above, slab.below, (self._from_below, *tail))])

    def forward_positions(self, positions: np.ndarray) -> np.ndarray:
        """Return ghost positions (count, 3), shifted by a period in z across the periodic face."""
        ghosts = self.forward(positions)
        slab = self.decomposition
        if slab.rank == slab.size - 1:
            ghosts[: self._from_above, 2] += slab.length
        if slab.rank == 0:
            ghosts[self._from_above :, 2] -= slab.length
        return ghosts

    def adjoint(self, ghosts: np.ndarray) -> np.ndarray:
        """Apply the transpose of `forward` to `ghosts` (count, ...). Return for each owned row the sum of its ghost
        rows on all ranks, (n, ...)."""
        ghosts = np.asarray(ghosts)
        slab, tail = self.decomposition, ghosts.shape[1:]
        owned = np.zeros((self.owned, *tail), ghosts.dtype)
        # An owned row occurs at most once in each list. Otherwise indexed addition would leave out repeated rows.
        owned[self._down] += _exchange(slab, ghosts[: self._from_above], slab.above, slab.below,
                                       (len(self._down), *tail))
        owned[self._up] += _exchange(slab, ghosts[self._from_above :], slab.below, slab.above, (len(self._up), *tail))
        return owned


class PlaneHalo:
    """Ghost planes of the neighbouring slabs: `below` planes under this rank's planes, and `above` planes over them.

    The slabs are periodic: the first and the last one are neighbours. With a single rank its own planes are the ghosts,
    and no message is sent. Raises HaloError if a slab has fewer planes than `below` or `above`.
    """

    def __init__(self, decomposition: SlabDecomposition, below: int, above: int) -> None:
        self.decomposition, self.below, self.above = decomposition, below, above
        _require_planes(decomposition, max(below, above), "the interpolation")

    def forward(self, planes: np.ndarray) -> list[np.ndarray]:
        """Return the ghost planes below (c, below, ...), `planes` (c, z_local, ...), and the ghost planes above."""
        slab, count = self.decomposition, planes.shape[1]
        lowest, highest = planes[:, : self.above], planes[:, count - self.below :]
        if slab.size == 1:
            return [highest, planes, lowest]
        from_above = _exchange(slab, lowest, slab.below, slab.above, lowest.shape)
        from_below = _exchange(slab, highest, slab.above, slab.below, highest.shape)
        return [from_below, planes, from_above]

    def parts(self, planes: np.ndarray) -> list[np.ndarray]:
        """Return what `adjoint` takes: ghost planes of zeros, `planes` (c, z_local, ...), and ghost planes of zeros.

        The caller adds its values to these arrays before it calls `adjoint`.
        """
        below, above = (np.zeros((len(planes), count, *planes.shape[2:]), planes.dtype)
                        for count in (self.below, self.above))
        return [below, planes, above]

    def adjoint(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Apply the transpose of `forward` to arrays that `parts` has made. Add the ghost planes to the planes
        (c, z_local, ...) of their owners in place, and return this rank's planes."""
        highest, planes, lowest = parts
        slab, count = self.decomposition, planes.shape[1]
        if slab.size > 1:
            lowest, highest = (_exchange(slab, lowest, slab.above, slab.below, lowest.shape),
                               _exchange(slab, highest, slab.below, slab.above, highest.shape))
        planes[:, : self.above] += lowest
        planes[:, count - self.below :] += highest
        return planes


def require_thick_slabs(decomposition: SlabDecomposition, width: float) -> None:
    """Raise HaloError, which names the largest usable number of ranks, if a slab is thinner than `width`."""
    if decomposition.size > 1:
        _require_planes(decomposition, planes_within(width, decomposition.spacing), f"width {width:.4g}")


def planes_within(width: float, spacing: float) -> int:
    """Return the number of planes of a grid with this spacing that cover the distance `width`."""
    return rounded_up(width / spacing)


def most_slabs(planes: int, needed: int) -> int:
    """Return the largest number of slabs of a grid, with `planes` planes in all, that have `needed` planes each."""
    return max(planes // max(needed, 1), 1)


def thick_slabs(planes: int, length: float, width: float) -> int:
    """Return the largest number of slabs, at least as thick as `width`, of a cube of side `length`."""
    return most_slabs(planes, planes_within(width, length / planes))


def _require_planes(slab: SlabDecomposition, needed: int, purpose: str) -> None:
    thinnest = slab.planes // slab.size  # see `block_starts`
    if thinnest < needed:
        raise HaloError(f"{slab.size} ranks make slabs of {thinnest} planes, thinner than the halo of {needed} "
                        f"planes ({purpose}); use at most {most_slabs(slab.planes, needed)} ranks")


def _exchange(slab: SlabDecomposition, sent: np.ndarray, destination: int, source: int,
              shape: tuple[int, ...]) -> np.ndarray:
    """Send an array to `destination` and return the array of this shape that `source` sends."""
    received = np.empty(shape, sent.dtype)
    slab.comm.Sendrecv([np.ascontiguousarray(sent), MPI.BYTE], destination, recvbuf=[received, MPI.BYTE],
                       source=source)
    return received
