"""Neighbour lists: all pairs of particles within a radius."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.library import library
from eddies.kernels.neighbors import Box, neighbors_within, pairs_within
from eddies.particles.cell_grid import CellGrid, blocks_of
from eddies.particles.devices import kernels_serve
from eddies.particles.pairs import Pairs, gather_rows
from eddies.particles.periodic_box import PeriodicBox, safe_norm

__all__ = ["NeighborList", "Pairs"]


class NeighborList:
    """All senders within `cutoff` + `skin` of each receiver, found with a sorted cell list.

    Parameters
    ----------
    box : the periodic box.
    cutoff : float, radius within which pairs interact.
    skin : float, extra radius: the list holds until something has moved by `skin`/2.

    The list is in compressed rows: the senders of receiver i are `senders[offsets[i]:offsets[i + 1]]`. Its
    length is counted, never guessed. It is symmetric where the receivers are among the senders. `builds`
    counts the builds. Raises ValueError unless the radius is positive and less than half the box, where
    nearest images are unique.
    """

    def __init__(self, box: PeriodicBox, cutoff: float, skin: float) -> None:
        if not (cutoff > 0 and skin >= 0 and cutoff + skin < box.length / 2):
            raise ValueError(
                f"cutoff {cutoff:.6g} and skin {skin:.6g}: the cutoff must be positive, and both "
                f"together less than half the box, {box.length / 2:.6g}"
            )
        self.box, self.cutoff, self.skin = box, cutoff, skin
        self.builds = 0

    def build(self, receivers: Tensor, senders: Tensor, exclude_self: bool) -> None:
        """List the pairs of receivers (n, 3) and senders (s, 3).

        With `exclude_self` receiver row i is sender row i and is not its own neighbour. Raises ValueError if
        a position is not finite.
        """
        receivers, senders = receivers.detach(), senders.detach()
        if not (torch.isfinite(receivers).all() and torch.isfinite(senders).all()):
            raise ValueError("neighbour list: a position is not finite")
        # Slightly too far: whether a pair at the very edge interacts is decided in `pairs`, the same way for
        # both.
        reach = (self.cutoff + self.skin) * (1 + 1e-9)
        self.builds += 1
        self._receivers = None
        if kernels_serve(receivers.device):
            found = neighbors_within(library(), self._space, reach, receivers.numpy(), senders.numpy(), exclude_self)
            self.offsets, self.senders = map(torch.from_numpy, found)
            return
        grid = CellGrid(self.box, senders, reach)
        found = [(receivers.new_empty(0, dtype=torch.int64),) * 2]
        for receiver, sender in grid.search(self.box.wrap(receivers).T.contiguous()):
            if exclude_self:
                other = torch.nonzero(receiver != sender).squeeze(1)
                receiver, sender = receiver.index_select(0, other), sender.index_select(0, other)
            found.append((receiver, sender))
        self._receivers, self.senders = (torch.cat(column) for column in zip(*found))
        neighbors = torch.bincount(self._receivers, minlength=len(receivers))
        self.offsets = torch.cat([neighbors.new_zeros(1), neighbors.cumsum(0)])

    def blocks(self, together: int) -> Iterator[slice]:
        """Consecutive receivers with about `together` listed pairs; one empty block without receivers."""
        if len(self.offsets) == 1:
            yield slice(0, 0)
        for first, last in blocks_of(self.offsets[1:], together):
            yield slice(first, last)

    def pairs(
        self,
        receivers: Tensor,
        senders: Tensor,
        rows: Tensor | slice | None = None,
        dtype: torch.dtype | None = None,
        once: bool = False,
    ) -> Pairs:
        """The pairs that are within the cutoff now, differentiable in the positions.

        Parameters
        ----------
        receivers, senders : (n, 3) and (s, 3), the present positions of the rows the list was built from.
        rows : receivers to keep, as row numbers (k,) or a slice; output row k is then the k-th of them.
        dtype : type of displacement and distance, that of the positions unless given. It is applied after the
            nearest image is taken, so single precision loses nothing to the size of the box.
        once : leave out the second of the two orders of each pair of receivers; for lists whose senders are the
            receivers, then others.
        """
        recorded = torch.is_grad_enabled() and (receivers.requires_grad or senders.requires_grad)
        if kernels_serve(receivers.device) and not recorded:
            return self._compiled_pairs(receivers, senders, rows, dtype or receivers.dtype, once)
        receiver, segment, sender, count = self._listed(rows)
        if once:
            first = torch.nonzero(receiver < sender).squeeze(1)
            receiver, segment, sender = (index.index_select(0, first) for index in (receiver, segment, sender))
        # One component at a time: much faster than (m, 3) rows.
        points, others = receivers.T.contiguous(), senders.T.contiguous()
        with torch.no_grad():
            components = self._components(points, others, receiver, sender)
            square = sum(component * component for component in components)
            near = torch.nonzero(square < self.cutoff**2).squeeze(1)
        receiver, segment, sender = (index.index_select(0, near) for index in (receiver, segment, sender))
        if recorded:
            components = self._components(points, others, receiver, sender)
        else:
            components = [component.index_select(0, near) for component in components]
        displacement = torch.stack([component.to(dtype or points.dtype) for component in components])
        return Pairs(receiver, segment, sender, displacement.T, safe_norm(displacement, dim=0), count)

    @property
    def _space(self) -> Box:
        return Box(self.box.length, self.box.periodic_z)

    def _compiled_pairs(self, receivers: Tensor, senders: Tensor, rows: Tensor | slice | None, dtype: torch.dtype,
                        once: bool) -> Pairs:
        total = len(self.offsets) - 1
        if isinstance(rows, Tensor):
            numbers = rows.numpy()
        else:
            numbers = np.arange(*(rows or slice(None)).indices(total))
        found = pairs_within(library(), self._space, self.cutoff, receivers.detach().numpy(), senders.detach().numpy(),
                             self.offsets.numpy(), self.senders.numpy(), numbers, once,
                             np.dtype(str(dtype).removeprefix("torch.")))
        receiver, segment, sender, displacement, distance = map(torch.from_numpy, found)
        return Pairs(receiver, segment, sender, displacement.T, distance, len(numbers))

    def _components(self, points: Tensor, others: Tensor, receiver: Tensor, sender: Tensor) -> list[Tensor]:
        return [
            self.box.nearest_image(x.index_select(0, receiver) - y.index_select(0, sender), axis)
            for axis, (x, y) in enumerate(zip(points, others))
        ]

    def _listed(self, rows: Tensor | slice | None) -> tuple[Tensor, Tensor, Tensor, int]:
        """Receiver, output row and sender of each listed pair, and the number of output rows."""
        receivers = len(self.offsets) - 1
        if self._receivers is None:
            self._receivers = torch.repeat_interleave(torch.arange(receivers, device=self.offsets.device),
                                                      self.offsets.diff())
        if rows is None:
            return self._receivers, self._receivers, self.senders, receivers
        if isinstance(rows, slice):
            first, last, _ = rows.indices(receivers)
            listed = slice(int(self.offsets[first]), int(self.offsets[last]))
            receiver = self._receivers[listed]
            return receiver, receiver - first, self.senders[listed], last - first
        length = self.offsets[rows + 1] - self.offsets[rows]
        stop = length.cumsum(0)
        segment = torch.repeat_interleave(torch.arange(len(rows), device=rows.device), length)
        position = gather_rows(self.offsets[rows] - (stop - length), segment)
        listed = position + torch.arange(len(segment), device=rows.device)
        return rows[segment], segment, self.senders[listed], len(rows)
