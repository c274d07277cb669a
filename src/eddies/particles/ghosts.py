"""Copies of the neighbouring ranks' particles as a differentiable operation."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.parallel.halo import HaloExchange
from eddies.particles.particle_set import as_numpy


class _GhostExchange(torch.autograd.Function):
    """Rows of owned particles to the ranks that see them; backwards, gradients of the copies to their owners.

    Both directions are collective: as long as all ranks compute the same expression, whatever their number of
    particles, all of them also take part in the backward exchange, in the same order.
    """

    @staticmethod
    def forward(ctx, owned: Tensor, halo: HaloExchange, positions: bool) -> Tensor:
        ctx.halo = halo
        exchange = halo.forward_positions if positions else halo.forward
        return torch.from_numpy(exchange(as_numpy(owned))).to(owned.device)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        return torch.from_numpy(ctx.halo.adjoint(as_numpy(gradient))).to(gradient.device), None, None


def exchange_ghosts(halo: HaloExchange, owned: Tensor) -> Tensor:
    """Ghost rows (halo.count, ...) of a column of owned particles (n, ...); collective, differentiable."""
    return _GhostExchange.apply(owned, halo, False)


def exchange_ghost_positions(halo: HaloExchange, positions: Tensor) -> Tensor:
    """Ghost positions (halo.count, 3), moved by one period in z beyond the periodic face; collective."""
    return _GhostExchange.apply(positions, halo, True)
