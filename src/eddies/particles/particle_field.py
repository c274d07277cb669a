"""Particles at one moment as samples of a field: averages, moving least squares and kriging, on a grid and at the
particles themselves."""

from __future__ import annotations

from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.library import library
from eddies.kernels.neighbors import Box
from eddies.kernels.pairs import PairSpace
from eddies.kernels.reconstruction import GridPlanes, fitted, sums_on_grid, told_kernel
from eddies.parallel.halo import HaloExchange
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import kernels_serve
from eddies.particles.exchanges import exchange_ghost_positions, exchange_ghosts
from eddies.particles.kriging import Covariance, interpolated
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pairs import CompiledSum, Pairs, compiled_sums
from eddies.particles.particle_set import as_numpy
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reconstruction import (RIDGE, moving_least_squares, normalisation, reconstruct_on_grid,
                                             reconstruct_with_gradient)
from eddies.particles.smoothing_kernels import HermiteKernel, SmoothingKernel

# Pairs taken together where no gradient is recorded: about a core's cache.
PAIRS_TOGETHER = 1 << 16
# Of kriging, which has ten weights of each: enough receivers for as many threads as there are.
KRIGED_TOGETHER = 1 << 20


class ParticleField:
    """This rank's particles with the ghosts within `support`, and grid points among them.

    The grid has one cell for each plane of the slabs; its points on this rank are numbered z slowest.

    Parameters
    ----------
    decomposition : slabs that hold the particles. support : radius of the kernels to be used.
    position, velocity : (n, 3), owned particles.
    dtype : of the pair arithmetic.
    """

    def __init__(self, decomposition: SlabDecomposition, support: float, position: Tensor, velocity: Tensor,
                 dtype: torch.dtype = torch.float32) -> None:
        self.decomposition, self.dtype, self.owned, self.support = decomposition, dtype, position, support
        self.halo = HaloExchange(decomposition, as_numpy(position), support)
        self._position = torch.cat([position, exchange_ghost_positions(self.halo, position)])
        self._velocity = torch.cat([velocity, exchange_ghosts(self.halo, velocity)]).to(dtype)
        self.points = grid_points(decomposition, decomposition.planes).to(position.device)
        self._entries: Tensor | None = None

    def volumes(self, kernel: SmoothingKernel) -> Tensor:
        """Volumes 1 / sum_j W(x_i - x_j), i itself counted, or the kernel's mean volume, of all local particles (s,);
        collective, differentiable."""
        if kernel.mean_volume is not None:
            return self._velocity.new_full((len(self._position),), kernel.mean_volume)
        if kernels_serve(self.owned.device) and not torch.is_grad_enabled():
            sums, = self._sums(kernel, "kernel-sum", 1, self._position, len(self.owned))
            return self._with_ghosts(1 / (sums[0] + kernel.value(sums.new_zeros(()))))
        return self._with_ghosts(torch.cat([1 / pairs.sum(kernel.value(pairs.distance)) for pairs in self._own_pairs]))

    def volumes_by_table(self, kernel: HermiteKernel) -> Tensor:
        """The same of a tabulated kernel, fast for one table after the other: what an entry adds to the sum of each
        particle is found once, 8 bytes for each knot and particle. Collective, differentiable."""
        if kernel.mean_volume is not None:
            return self.volumes(kernel)
        if self._entries is None or self._entries.shape[1] != len(kernel.table):
            with torch.no_grad():
                self._entries = torch.cat([self._by_entry(kernel, pairs) for pairs in self._own_pairs])
            del self._own_pairs
        return self._with_ghosts(1 / (self._entries @ kernel.table))

    def _by_entry(self, kernel: HermiteKernel, pairs: Pairs) -> Tensor:
        entries, factors = kernel.in_table(pairs.distance)
        total = len(kernel.table)
        sums = pairs.distance.new_zeros(pairs.count * total)
        return sums.index_add_(0, (entries + pairs.segment * total).flatten(), factors.flatten()).reshape(-1, total)

    def _with_ghosts(self, own: Tensor) -> Tensor:
        return torch.cat([own, exchange_ghosts(self.halo, own)])

    def on_grid(self, kernel: SmoothingKernel, volume: Tensor, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and its gradient (k, 3, 3) at some of this rank's grid points; differentiable."""
        pairs = self._around.pairs(self.points, self._position, rows, self.dtype)
        return reconstruct_with_gradient(kernel, pairs, volume, self._velocity)

    @torch.no_grad()
    def averaged(self, kernel: SmoothingKernel, volume: Tensor, receivers: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and gradient (k, 3, 3) at any points of this rank, by the kernel's `volumes`."""
        if kernels_serve(self.owned.device):
            none = self._velocity.new_zeros(len(receivers), 4)
            return self._averages(kernel, torch.cat([receivers, self._position]),
                                  torch.cat([none, self._columns(volume)]), none)
        neighbors = self._neighbors_of(receivers)
        return _joined(reconstruct_with_gradient(kernel, neighbors.pairs(receivers, self._position, block, self.dtype),
                                                 volume, self._velocity) for block in neighbors.blocks(PAIRS_TOGETHER))

    @torch.no_grad()
    def velocity_on_whole_grid(self, kernel: SmoothingKernel, volume: Tensor) -> Tensor:
        """Velocity (m, 3) at all of this rank's grid points, cheaper than with its gradient; not differentiable."""
        if kernels_serve(self.owned.device):
            slab = self.decomposition
            weighted = volume.unsqueeze(1) * torch.cat([torch.ones_like(volume).unsqueeze(1), self._velocity], dim=1)
            planes = GridPlanes(slab.planes, slab.spacing, slab.start, slab.count, slab.size == 1)
            sums = torch.from_numpy(sums_on_grid(library(), planes, _told(kernel), self._position.numpy(),
                                                 weighted.numpy()))
            return sums[:, 1:] * normalisation(kernel, sums[:, :1])
        return reconstruct_on_grid(kernel, self.decomposition, self._position, volume, self._velocity)

    @torch.no_grad()
    def at_particles(self, kernel: SmoothingKernel, volume: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (n, 3) and gradient (n, 3, 3) [component, direction] at the owned particles."""
        if kernels_serve(self.owned.device):
            columns = self._columns(volume)
            itself = columns[: len(self.owned)].clone()
            itself[:, :1] *= kernel.value(itself.new_zeros(()))
            return self._averages(kernel, self._position, columns, itself)
        return _joined(reconstruct_with_gradient(kernel, pairs, volume, self._velocity) for pairs in self._own_pairs)

    # ---- by other forms, at any points of this rank (k, 3)

    @torch.no_grad()
    def fitted(self, kernel: SmoothingKernel, degree: int, mean_volume: float,
               receivers: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and gradient (k, 3, 3) by `moving_least_squares`."""
        neighbors = self._neighbors_of(receivers)
        if not kernels_serve(self.owned.device):
            return _joined(moving_least_squares(
                kernel, neighbors.pairs(receivers, self._position, block, torch.float64), degree, mean_volume,
                self._velocity) for block in neighbors.blocks(PAIRS_TOGETHER))
        box = Box(self.decomposition.length, self.decomposition.size == 1)
        found = torch.from_numpy(fitted(library(), box, degree, _told(kernel), mean_volume, RIDGE,
                                        neighbors.offsets.numpy(), neighbors.senders.numpy(), receivers.numpy(),
                                        self._position.numpy(), self._velocity.numpy())).to(self.dtype)
        return found[:, 0], found[:, 1:].transpose(1, 2)

    @torch.no_grad()
    def kriged(self, covariance: Covariance, receivers: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and gradient (k, 3, 3) by kriging with all neighbours within the support: `interpolated`."""
        neighbors = self._neighbors_of(receivers)
        return _joined(interpolated(neighbors.pairs(receivers, self._position, block, self.dtype), self.support,
                                    covariance, self._velocity) for block in neighbors.blocks(KRIGED_TOGETHER))

    # ---- by the compiled library

    def _columns(self, volume: Tensor) -> Tensor:
        """Volume and velocity of each particle, (s, 4)."""
        return torch.cat([volume.unsqueeze(1), self._velocity], dim=1)

    def _averages(self, kernel: SmoothingKernel, position: Tensor, columns: Tensor,
                  itself: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (m, 3) and its gradient (m, 3, 3) at the first m of some positions (s, 3), from sums over all
        others, which have `columns` (s, 4) of volume and velocity. `itself` (m, 4): V W(0) of each as one of its own
        neighbours, and the velocity that others are taken relative to."""
        sums = self._sums(kernel, "kernel-average", 16, position, len(itself), tuple(columns.T))[0]
        weight, own = sums[:1] + itself.T[:1], itself.T[1:]
        factor = normalisation(kernel, weight)
        relative = sums[1:4] * factor
        if kernel.mean_volume is not None:
            relative = relative + (weight - 1) * own
        gradient = (sums[7:].reshape(3, 3, -1) - relative.unsqueeze(1) * sums[4:7]) * factor
        return (relative + own).T, gradient.permute(2, 0, 1)

    def _sums(self, kernel: SmoothingKernel, kind: str, components: int, position: Tensor, count: int,
              scalars: tuple[Tensor, ...] = ()) -> tuple[Tensor, ...]:
        """Sums over the particles within the support, (components, count), of the first `count` positions."""
        space = PairSpace(self.decomposition.length, self.decomposition.size == 1, kernel.support, 1.0, 1.0, False)
        wanted = np.arange(len(position)) < count
        told = CompiledSum(kind, _told(kernel), scalars=scalars, reads_velocity=False)
        found = compiled_sums(space, [told], [torch.ones(components)], position, None, wanted, self.dtype)
        return tuple(sums[:, :count] for sums in found)

    @cached_property
    def _own_pairs(self) -> list[Pairs]:
        """Pairs of the owned particles, each with itself too, in blocks."""
        neighbors = self._neighbors_of(self.owned)
        return [neighbors.pairs(self.owned, self._position, block, self.dtype)
                for block in neighbors.blocks(PAIRS_TOGETHER)]

    @cached_property
    def _around(self) -> NeighborList:
        """The particles around grid points."""
        return self._neighbors_of(self.points)

    def _neighbors_of(self, receivers: Tensor) -> NeighborList:
        box = PeriodicBox(self.decomposition.length, periodic_z=self.decomposition.size == 1)
        found = NeighborList(box, self.support, 0.0)
        found.build(receivers, self._position, exclude_self=False)
        return found


def grid_points(slab: SlabDecomposition, cells: int) -> Tensor:
    """The points (m, 3) of a grid of `cells`^3 that lie in this slab, z slowest."""
    axis = torch.arange(cells, dtype=torch.float64) * (slab.length / cells)
    # In whole numbers: of points on the faces of slabs coordinates would tell by their rounding.
    first, end = (-(-plane * cells // slab.planes) for plane in (slab.start, slab.stop))
    own = axis[first:end]
    z, y, x = torch.meshgrid(own, axis, axis, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), z.flatten()], dim=1)


def _told(kernel: SmoothingKernel) -> tuple[float, ...]:
    return told_kernel(kernel.support, kernel.pieces.numpy(), kernel.mean_volume is not None)


def _joined(blocks) -> tuple[Tensor, Tensor]:
    velocities, gradients = zip(*blocks)
    return torch.cat(velocities), torch.cat(gradients)
