"""Sums and means over the particles of all ranks as differentiable operations."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum
from eddies.particles.particle_set import as_numpy


class _GlobalSum(torch.autograd.Function):
    """Sum over ranks, on every rank. Its adjoint is the same sum: each rank's loss depends on each contribution."""

    @staticmethod
    def forward(ctx, values: Tensor, comm: Comm) -> Tensor:
        ctx.comm = comm
        return torch.from_numpy(global_sum(comm, as_numpy(values))).to(values.device)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(global_sum(ctx.comm, as_numpy(gradient))).to(gradient.device), None


def sum_over_ranks(comm: Comm, values: Tensor) -> Tensor:
    """Sum of a tensor over ranks, on every rank; differentiable, collective both ways."""
    return _GlobalSum.apply(values, comm)


def mean_over_ranks(comm: Comm, rows: Tensor) -> Tensor:
    """Mean (k,) of rows (n, k) over the particles of all ranks, of which there is one at least; in one message,
    differentiable, collective both ways."""
    total = sum_over_ranks(comm, torch.cat([rows.sum(0), rows.new_tensor([len(rows)])]))
    return total[:-1] / total[-1]
