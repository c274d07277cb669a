"""Neighbour lists: all pairs of particles within a radius."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.library import library
from eddies.kernels.neighbors import Box, neighbors_within, pairs_within
from eddies.particles.devices import kernels_serve
from eddies.particles.pairs import Pairs, gather_rows
from eddies.particles.periodic_box import PeriodicBox, safe_norm

# Receivers, and their candidates, that are looked at together: few enough for the cache of a core, or enough
# to keep an accelerator busy.
RECEIVERS_TOGETHER = {"cpu": 1 << 11, "cuda": 1 << 16}
CANDIDATES_TOGETHER = {"cpu": 1 << 16, "cuda": 1 << 23}
# Cells per reach along y and z, and along x. Cells are finer along x, where they cost no extra row of cells.
CELLS_PER_REACH, CELLS_PER_REACH_X = 2, 8


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


class CellGrid:
    """Particles and their periodic images sorted by cell, x fastest: a row of cells is a range of particles.

    Parameters
    ----------
    box : the periodic box.
    senders : (s, 3), positions.
    reach : float, the search radius, less than half the box.

    Cells are at least `reach`/2 wide in y and z, so at most 25 rows of cells can hold the neighbours of a
    point. There are never many more cells than particles, so voids cost nothing.
    """

    def __init__(self, box: PeriodicBox, senders: Tensor, reach: float) -> None:
        self.reach = reach
        positions, index = _with_images(box, senders, reach)
        self.lower = positions.amin(1) if len(index) else positions.new_zeros(3)
        extent = positions.amax(1) - self.lower if len(index) else positions.new_zeros(3)
        most = 2 * math.ceil(max(len(index), 1) ** (1 / 3)) + 1
        per_reach = (CELLS_PER_REACH_X, CELLS_PER_REACH, CELLS_PER_REACH)
        wanted = [int(length * finer / reach) for length, finer in zip(extent.tolist(), per_reach)]
        self.cells = [min(max(cells, 1), most * finer) for cells, finer in zip(wanted, (4, 1, 1))]
        # A little wider than the extent, so that the largest coordinate falls into the last cell.
        extent = torch.clamp(extent * (1 + 1e-12), min=reach / CELLS_PER_REACH_X)
        self.side = extent / extent.new_tensor(self.cells)
        cell = [self._cell(positions[axis], axis).clamp_(0, self.cells[axis] - 1) for axis in range(3)]
        key = (cell[2] * self.cells[1] + cell[1]) * self.cells[0] + cell[0]
        order = torch.argsort(key)
        self.positions, self.index = positions[:, order], index[order]
        occupation = torch.bincount(key, minlength=math.prod(self.cells))
        self.starts = torch.cat([occupation.new_zeros(1), occupation.cumsum(0)])

    def search(self, receivers: Tensor) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield (receiver, sender), two int64 (m,), within reach of receivers (3, n) that lie in the box."""
        device = receivers.device.type
        for first in range(0, receivers.shape[1], RECEIVERS_TOGETHER[device]):
            points = receivers[:, first : first + RECEIVERS_TOGETHER[device]]
            ranges = self._ranges(points)
            for block in ranges.blocks(CANDIDATES_TOGETHER[device]):
                point, candidate = ranges.expand(*block)
                near = self._within_reach(points, point, candidate)
                sender = self.index.index_select(0, candidate.index_select(0, near))
                yield point.index_select(0, near) + first, sender

    def _within_reach(self, points: Tensor, point: Tensor, candidate: Tensor) -> Tensor:
        """Which of the pairs of a point and a candidate are near enough: int64 (k,)."""
        square = 0.0
        for axis in range(3):
            difference = points[axis].index_select(0, point) - self.positions[axis].index_select(0, candidate)
            square = difference * difference + square
        return torch.nonzero(square <= self.reach**2).squeeze(1)

    def _cell(self, coordinate: Tensor, axis: int) -> Tensor:
        return torch.floor((coordinate - self.lower[axis]) / self.side[axis]).to(torch.int64)

    def _start_of(self, cell: Tensor) -> Tensor:
        return self.starts.index_select(0, cell.flatten()).reshape(cell.shape)

    def _rows_near(self, coordinate: Tensor, axis: int) -> tuple[Tensor, Tensor]:
        """Rows of cells around each coordinate (n,) along `axis` and squared distance to each: (rows, n)."""
        side = float(self.side[axis])
        around = math.ceil(self.reach / side)
        offset = torch.arange(-around, around + 1, device=coordinate.device).unsqueeze(1)
        home = self._cell(coordinate, axis)
        within = (coordinate - self.lower[axis]) - home * side
        gap = torch.where(offset > 0, offset * side - within, within - (offset + 1) * side)
        return home + offset, torch.where(offset == 0, torch.zeros_like(gap), gap.clamp(min=0)) ** 2

    def _ranges(self, receivers: Tensor) -> _Ranges:
        """The ranges of sorted particles that hold each receiver's neighbours, one range a row of cells."""
        row_y, square_y = self._rows_near(receivers[1], 1)
        row_z, square_z = self._rows_near(receivers[2], 2)
        square = self.reach**2 - square_y.unsqueeze(0) - square_z.unsqueeze(1)
        inside_y, inside_z = (row_y >= 0) & (row_y < self.cells[1]), (row_z >= 0) & (row_z < self.cells[2])
        reached = (square >= 0) & inside_y.unsqueeze(0) & inside_z.unsqueeze(1)
        half = torch.sqrt(square.clamp(min=0))
        row = (row_z.unsqueeze(1) * self.cells[1] + row_y.unsqueeze(0)) * self.cells[0]
        row = torch.where(reached, row, torch.zeros_like(row))
        first = self._cell(receivers[0] - half, 0).clamp_(0, self.cells[0])
        last = (self._cell(receivers[0] + half, 0) + 1).clamp_(0, self.cells[0])
        start, stop = self._start_of(row + first), self._start_of(row + last)
        length = torch.where(reached, stop - start, torch.zeros_like(start))
        return _Ranges(start.flatten(0, 1).T.contiguous(), length.flatten(0, 1).T.contiguous())


@dataclass(frozen=True)
class _Ranges:
    """Several ranges of integers for each receiver: `start` and `length`, int64 (n, ranges)."""

    start: Tensor
    length: Tensor

    def blocks(self, together: int) -> Iterator[tuple[int, int]]:
        """Consecutive receivers [first, last) with about `together` integers, or one receiver."""
        return blocks_of(self.length.sum(1).cumsum(0), together)

    def expand(self, first: int, last: int) -> tuple[Tensor, Tensor]:
        """The receiver of each integer, and the integer, for receivers [first, last): two (m,) arrays."""
        length = self.length[first:last].flatten()
        stop = length.cumsum(0)
        total = int(stop[-1])
        shift = self.start[first:last].flatten() - (stop - length)
        integer = torch.repeat_interleave(shift, length, output_size=total)
        integer += torch.arange(total, device=shift.device)
        rows = torch.arange(first, last, device=shift.device)
        return torch.repeat_interleave(rows, self.length[first:last].sum(1), output_size=total), integer


def blocks_of(cumulative: Tensor, together: int) -> Iterator[tuple[int, int]]:
    """Consecutive rows [first, last) that hold about `together` items, at least one row each.

    `cumulative` (n,) counts the items up to and including each row.
    """
    if not len(cumulative):
        return
    targets = torch.arange(together, int(cumulative[-1]) + together, together, device=cumulative.device)
    ends = torch.searchsorted(cumulative, targets, right=True)
    bounds = [0] + [end for end in torch.unique(ends).tolist() if end > 0]
    if bounds[-1] != len(cumulative):
        bounds.append(len(cumulative))
    yield from zip(bounds[:-1], bounds[1:])


def _with_images(box: PeriodicBox, senders: Tensor, reach: float) -> tuple[Tensor, Tensor]:
    """Positions (3, s') of senders (s, 3), wrapped, and their images within reach; rows (s',)."""
    positions = box.wrap(senders).T.contiguous()
    index = torch.arange(len(senders), device=senders.device)
    for axis in range(3):
        if not box.periodic[axis]:
            continue
        low = torch.nonzero(positions[axis] <= reach).squeeze(1)
        high = torch.nonzero(positions[axis] >= box.length - reach).squeeze(1)
        above, below = positions[:, low], positions[:, high]
        above[axis] += box.length
        below[axis] -= box.length
        positions = torch.cat([positions, above, below], dim=1)
        index = torch.cat([index, index[low], index[high]])
    return positions, index
