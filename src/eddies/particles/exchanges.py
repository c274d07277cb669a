"""Tensors over all ranks: ghost particles, changes of rank, sums and means, which are differentiable, and norms, which
are not."""

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.parallel.halo import HaloExchange
from eddies.parallel.migration import Redistribution
from eddies.parallel.reduction import global_max, global_sum
from eddies.particles.particle_set import as_numpy


class _GhostExchange(torch.autograd.Function):
    """Send rows of owned particles to ranks that have them as ghosts.

    The backward pass sends the gradients of ghosts back and adds them to the gradients of the owned rows.

    Both directions are collective. If all ranks compute the same expression, with any number of particles, they also
    take part in the backward exchanges in the same order.
    """

    @staticmethod
    def forward(ctx, owned: Tensor, halo: HaloExchange, positions: bool) -> Tensor:
        ctx.halo = halo
        exchange = halo.forward_positions if positions else halo.forward
        return torch.from_numpy(exchange(as_numpy(owned))).to(owned.device)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        return torch.from_numpy(ctx.halo.adjoint(as_numpy(gradient))).to(gradient.device), None, None


def with_ghosts(halo: HaloExchange, owned: Tensor, positions: bool = False) -> Tensor:
    """Column (n, ...) of the owned particles, followed by its ghost rows; collective, differentiable.

    If the column holds `positions`, ghosts beyond the periodic face in z are shifted by one period. A single rank has
    no ghosts.
    """
    if halo.decomposition.size == 1:
        return owned
    return torch.cat([owned, _GhostExchange.apply(owned, halo, positions)])


class _ChangeOfRank(torch.autograd.Function):
    """Move rows to other ranks. The backward pass sends the rows of the gradient back."""

    @staticmethod
    def forward(ctx, rows: Tensor, order: Redistribution) -> Tensor:
        ctx.order = order
        return torch.from_numpy(order.apply(as_numpy(rows))).to(rows.device)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.order.adjoint(as_numpy(gradient))).to(gradient.device), None


def redistributed(order: Redistribution, rows: Tensor) -> Tensor:
    """Rows (m, ...) of a column (n, ...) that belong to this rank in another order; differentiable, collective also in
    the backward pass."""
    return _ChangeOfRank.apply(rows, order)


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
    """Sum of a tensor over ranks, on every rank; differentiable, collective also in the backward pass."""
    return _GlobalSum.apply(values, comm)


def mean_over_ranks(comm: Comm, rows: Tensor) -> Tensor:
    """Mean (k,) of rows (n, k) over the particles of all ranks, in one message; differentiable.

    It is collective also in the backward pass. There must be at least one particle.
    """
    total = sum_over_ranks(comm, torch.cat([rows.sum(0), rows.new_tensor([len(rows)])]))
    return total[:-1] / total[-1]


def root_mean_square(comm: Comm, values: Tensor) -> float:
    """Root mean square of all entries on all ranks; collective. For vectors it is the rms of one component."""
    square, count = global_sum(comm, np.array([float(values.double().square().sum()), values.numel()]))
    return float(np.sqrt(square / count))


def relative_error(comm: Comm, error: Tensor, exact: Tensor) -> float:
    """Normalised L2 error |error| / |exact| over the entries of all ranks, NaN if `exact` is zero; collective.

    For velocities, `exact` are their `fluctuations`: a mean velocity depends on the frame of reference.
    """
    square, whole = global_sum(comm, np.array([float(part.detach().double().square().sum())
                                               for part in (error, exact)]))
    return float(np.sqrt(square / whole)) if whole > 0 else np.nan


def fluctuations(comm: Comm, rows: Tensor) -> Tensor:
    """Return rows (n, c) minus their mean over all ranks, in double precision; collective.

    The result is zero if no fluctuation is above the round-off error of the mean.
    """
    total = global_sum(comm, np.append(as_numpy(rows.double().sum(0)), len(rows)))
    mean = torch.from_numpy(total[:-1] / max(total[-1], 1.0)).to(rows.device)
    found, least = rows.double() - mean, 100 * torch.finfo(rows.dtype).eps * float(mean.abs().max())
    largest = float(global_max(comm, float(found.abs().max()) if found.numel() else 0.0))
    return found if largest > least else torch.zeros_like(found)
