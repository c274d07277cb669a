"""Pairs of neighbouring particles, and sums over each particle's neighbours."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Pairs:
    """Ordered pairs (i, j) of a receiver i and a sender j, sorted by receiver.

    Columns of pairs are stored component by component: a (m, 3) column is the transpose of a contiguous (3,
    m) array, several times faster for what is done to pairs.

    Parameters
    ----------
    receiver : int64 (m,), row of i among the local particles, or among the points that receive.
    segment : int64 (m,), row of i in the output, in [0, count), not decreasing.
    sender : int64 (m,), row of j among the local particles (owned, then ghosts).
    displacement : (m, 3), x_i - x_j between nearest images.
    distance : (m,), its length, with zero gradient where it vanishes.
    count : number of output rows.
    """

    receiver: Tensor
    segment: Tensor
    sender: Tensor
    displacement: Tensor
    distance: Tensor
    count: int

    @cached_property
    def offsets(self) -> Tensor:
        """First pair of each output row, and the number of pairs: int64 (count + 1,)."""
        rows = torch.arange(self.count + 1, device=self.segment.device)
        return torch.searchsorted(self.segment, rows)

    def at_receivers(self, column: Tensor) -> Tensor:
        """A particle column (n, ...) at the receiver of each pair: (m, ...)."""
        return gather_rows(column, self.receiver)

    def at_senders(self, column: Tensor) -> Tensor:
        """A particle column (n, ...) at the sender of each pair: (m, ...)."""
        return gather_rows(column, self.sender)

    def sum(self, values: Tensor) -> Tensor:
        """Sum of pair values (m, ...) over the pairs of each output row: (count, ...); zero without pairs.

        The order of summation is fixed, so the result is the same from run to run.
        """
        by_component = torch.atleast_2d(values.flatten(1).T if values.dim() > 1 else values).contiguous()
        sums = _SegmentSum.apply(by_component, self.offsets, self.segment)
        return sums.T.reshape(self.count, *values.shape[1:])

    def add_to_both(self, values: Tensor, parity: Tensor, totals: Tensor) -> None:
        """Add values (components, m) of pairs that stand once to totals (components, n) of the owned particles.

        A value is added at the receiver and, times its `parity` (components,), 1 or -1, at the sender, unless that is
        a ghost, whose owner has the pair as well. It works in place; the order is fixed, except on a GPU.
        """
        totals.index_add_(1, self.receiver, values)
        home = torch.nonzero(self.sender < totals.shape[1]).squeeze(1)
        totals.index_add_(1, self.sender.index_select(0, home), parity[:, None] * values.index_select(1, home))


def gather_rows(column: Tensor, index: Tensor) -> Tensor:
    """column[index] for a column (n, ...): (m, ...), stored component by component."""
    if column.dim() == 1:
        return column.index_select(0, index)
    components = column.flatten(1).unbind(1)
    gathered = torch.stack([component.index_select(0, index) for component in components])
    return gathered.T.reshape(len(index), *column.shape[1:])


class _SegmentSum(torch.autograd.Function):
    """Sums of consecutive columns of a (components, m) array. On a CPU numpy's sum is the fastest."""

    @staticmethod
    def forward(ctx, values: Tensor, offsets: Tensor, segment: Tensor) -> Tensor:
        ctx.save_for_backward(segment)
        if values.device.type != "cpu":
            return torch.segment_reduce(values.T.contiguous(), "sum", offsets=offsets, axis=0).T.contiguous()
        starts, stops = offsets[:-1].numpy(), offsets[1:].numpy()
        filled = np.flatnonzero(stops > starts)
        sums = values.new_zeros(len(values), len(starts))
        if len(filled):
            # reduceat takes each sum up to the next start, so rows without pairs are left out of its starts.
            sums.numpy()[:, filled] = np.add.reduceat(values.detach().numpy(), starts[filled], axis=1)
        return sums

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        (segment,) = ctx.saved_tensors
        components = [component.index_select(0, segment) for component in gradient.unbind(0)]
        return torch.stack(components), None, None
