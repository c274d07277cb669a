"""Particles at one moment as samples of a field: kernel averages on a grid and at the particles themselves."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.parallel.halo import HaloExchange
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.ghosts import exchange_ghost_positions, exchange_ghosts
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import as_numpy
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reconstruction import reconstruct_with_gradient
from eddies.particles.smoothing_kernels import SmoothingKernel

# Pairs taken together where no gradient is recorded: about a core's cache.
PAIRS_TOGETHER = 1 << 16


class ParticleCloud:
    """This rank's particles with the ghosts within `support`, and their neighbours around grid points.

    The grid has one cell for each plane of the slabs; its points on this rank are numbered z slowest.

    Parameters
    ----------
    decomposition : slabs that hold the particles. support : radius of the kernels to be used.
    position, velocity : (n, 3), owned particles.
    dtype : of the pair arithmetic.
    """

    def __init__(self, decomposition: SlabDecomposition, support: float, position: Tensor, velocity: Tensor,
                 dtype: torch.dtype = torch.float32) -> None:
        self.decomposition, self.dtype, self.owned = decomposition, dtype, position
        self.halo = HaloExchange(decomposition, as_numpy(position), support)
        self._position = torch.cat([position, exchange_ghost_positions(self.halo, position)])
        self._velocity = torch.cat([velocity, exchange_ghosts(self.halo, velocity)]).to(dtype)
        box = PeriodicBox(decomposition.length, periodic_z=decomposition.size == 1)
        self._neighbors, self._around = NeighborList(box, support, 0.0), NeighborList(box, support, 0.0)
        self._neighbors.build(position, self._position, exclude_self=False)
        self._points = grid_points(decomposition).to(position.device)
        self._around.build(self._points, self._position, exclude_self=False)
        self._own_pairs: Pairs | None = None

    def volumes(self, kernel: SmoothingKernel) -> Tensor:
        """Volumes 1 / sum_j W(x_i - x_j), i itself counted, of all local particles (s,); collective, differentiable."""
        if self._own_pairs is None:
            self._own_pairs = self._neighbors.pairs(self.owned, self._position, dtype=self.dtype)
        own = 1 / self._own_pairs.sum(kernel.value(self._own_pairs.distance))
        return torch.cat([own, exchange_ghosts(self.halo, own)])

    def on_grid(self, kernel: SmoothingKernel, volume: Tensor, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and its gradient (k, 3, 3) at some of this rank's grid points; differentiable."""
        pairs = self._around.pairs(self._points, self._position, rows, self.dtype)
        return reconstruct_with_gradient(kernel, pairs, volume, self._velocity)

    @torch.no_grad()
    def on_whole_grid(self, kernel: SmoothingKernel) -> tuple[Tensor, Tensor]:
        """Velocity (m, 3) and gradient (m, 3, 3) at all of this rank's grid points; collective."""
        volume = self.volumes(kernel)
        return _joined(self.on_grid(kernel, volume, block) for block in self._around.blocks(PAIRS_TOGETHER))

    @torch.no_grad()
    def at_particles(self, kernel: SmoothingKernel) -> tuple[Tensor, Tensor]:
        """Velocity (n, 3) and gradient (n, 3, 3) [component, direction] at the owned particles; collective."""
        volume = self.volumes(kernel)
        return _joined(
            reconstruct_with_gradient(
                kernel, self._neighbors.pairs(self.owned, self._position, block, self.dtype), volume, self._velocity)
            for block in self._neighbors.blocks(PAIRS_TOGETHER))


def grid_points(slab: SlabDecomposition) -> Tensor:
    """This slab's points (m, 3) of the grid that has as many cells as the slabs have planes, z slowest."""
    axis = torch.arange(slab.planes, dtype=torch.float64) * slab.spacing
    z, y, x = torch.meshgrid(axis[slab.start : slab.stop], axis, axis, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), z.flatten()], dim=1)


def _joined(blocks) -> tuple[Tensor, Tensor]:
    velocities, gradients = zip(*blocks)
    return torch.cat(velocities), torch.cat(gradients)
