"""Neighbour lists: all pairs of particles within a radius."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.neighbors import neighbors_within, pairs_within
from eddies.particles.devices import kernels_serve
from eddies.particles.pairs import Pairs, gather_rows
from eddies.particles.particle_set import as_numpy
from eddies.particles.periodic_box import PeriodicBox, safe_norm


class NeighborList:
    """All senders within `cutoff` + `skin` of each receiver.

    The list is in compressed rows: the senders of receiver i are `senders[offsets[i]:offsets[i + 1]]`. If i and j are
    both receivers and senders, the list holds both (i, j) and (j, i), or neither.

    Parameters
    ----------
    box : the periodic box.
    cutoff : radius within which pairs interact.
    skin : extra radius. The list remains valid until a particle has moved by `skin`/2.

    Raises ValueError unless `cutoff` is positive, `skin` is not negative, and their sum is less than half the box. Only
    within half the box are nearest images unique.
    """

    def __init__(self, box: PeriodicBox, cutoff: float, skin: float) -> None:
        if not (cutoff > 0 and skin >= 0 and cutoff + skin < box.length / 2):
            raise ValueError(f"cutoff {cutoff:.6g} and skin {skin:.6g}: the cutoff must be positive, and their sum "
                             f"less than half the box, {box.length / 2:.6g}")
        self.box, self.cutoff, self.skin = box, cutoff, skin

    def build(self, receivers: Tensor, senders: Tensor, exclude_self: bool) -> None:
        """List the pairs of receivers (n, 3) and senders (s, 3).

        With `exclude_self`, receiver i and sender i are one particle, which is not its own neighbour. Raises ValueError
        if a position is not finite.
        """
        if not (torch.isfinite(receivers).all() and torch.isfinite(senders).all()):
            raise ValueError("neighbour list: a position is not finite")
        # The radius is slightly larger, so that `pairs` alone decides which pairs count: alike for (i, j) and (j, i).
        reach = (self.cutoff + self.skin) * (1 + 1e-9)
        columns = neighbors_within(self.box, reach, as_numpy(receivers), as_numpy(senders), exclude_self)
        self.offsets, self.senders = (torch.from_numpy(column).to(receivers.device) for column in columns)

    def blocks(self, together: int) -> Iterator[slice]:
        """Yield slices of receivers, each with about `together` listed pairs; without receivers, one empty slice."""
        ends = self.offsets[1:]
        if not len(ends):
            yield slice(0, 0)
            return
        targets = torch.arange(together, int(ends[-1]) + together, together, device=ends.device)
        full = torch.unique(torch.searchsorted(ends, targets, right=True)).tolist()
        bounds = [0, *(row for row in full if 0 < row < len(ends)), len(ends)]
        for first, last in zip(bounds[:-1], bounds[1:]):
            yield slice(first, last)

    def pairs(self, receivers: Tensor, senders: Tensor, rows: Tensor | slice | None = None,
              dtype: torch.dtype | None = None) -> Pairs:
        """Return the pairs that lie within the cutoff at these positions; differentiable in the positions.

        Parameters
        ----------
        receivers, senders : (n, 3) and (s, 3), present positions of the particles that the list was built from.
        rows : receivers to keep, as row numbers (k,) or a slice. Output row i belongs to the i-th of them.
        dtype : type of displacement and distance; by default the type of the positions. Positions are
            subtracted before the conversion, so the size of the box costs no accuracy in single precision.
        """
        dtype, total = dtype or receivers.dtype, len(self.offsets) - 1
        numbers = (rows if isinstance(rows, Tensor) else
                   torch.arange(total, device=receivers.device)[rows or slice(None)])
        recorded = torch.is_grad_enabled() and (receivers.requires_grad or senders.requires_grad)
        if kernels_serve(receivers.device) and not recorded:
            return self._compiled_pairs(receivers, senders, numbers, dtype)
        receiver, segment, sender = self._listed(numbers)
        with torch.no_grad():
            square = sum(component.square() for component in self._difference(receivers, senders, receiver, sender))
            near = torch.nonzero(square < self.cutoff**2).squeeze(1)
        receiver, segment, sender = (index.index_select(0, near) for index in (receiver, segment, sender))
        components = self._difference(receivers, senders, receiver, sender)
        displacement = torch.stack([component.to(dtype) for component in components])
        return Pairs(receiver, segment, sender, displacement.T, safe_norm(displacement), len(numbers))

    def _compiled_pairs(self, receivers: Tensor, senders: Tensor, numbers: Tensor, dtype: torch.dtype) -> Pairs:
        kind = np.dtype(str(dtype).removeprefix("torch."))
        columns = pairs_within(self.box, self.cutoff, as_numpy(receivers), as_numpy(senders),
                               self.offsets.numpy(), self.senders.numpy(), numbers.numpy(), kind)
        receiver, segment, sender, displacement, distance = map(torch.from_numpy, columns)
        return Pairs(receiver, segment, sender, displacement.T, distance, len(numbers))

    def _difference(self, receivers: Tensor, senders: Tensor, receiver: Tensor, sender: Tensor) -> list[Tensor]:
        """Components of x_i - x_j between nearest images. Single components are faster than (m, 3) rows."""
        return [self.box.nearest_image(x.index_select(0, receiver) - y.index_select(0, sender), axis)
                for axis, (x, y) in enumerate(zip(receivers.unbind(1), senders.unbind(1)))]

    def _listed(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Receiver, output row and sender of each listed pair of the receivers `numbers` (k,). The output row of a pair
        is the index of its receiver in `numbers`."""
        length = self.offsets[numbers + 1] - self.offsets[numbers]
        segment = torch.repeat_interleave(torch.arange(len(numbers), device=numbers.device), length)
        shift = self.offsets[numbers] - (length.cumsum(0) - length)
        listed = gather_rows(shift, segment) + torch.arange(len(segment), device=numbers.device)
        return numbers[segment], segment, self.senders[listed]
