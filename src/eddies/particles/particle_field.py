"""Particles at one moment as samples of a velocity field: averages (Eqs. 5 and 6) and kriging, and their gradients."""

import logging
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.pairs import PairSpace
from eddies.kernels.reconstruction import kernel_numbers, sums_on_grid
from eddies.parallel.halo import HaloExchange
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import mean_over_ranks, with_ghosts
from eddies.particles.kriging import interpolated
from eddies.particles.neighborhood import NeighborList
from eddies.particles.pairs import CompiledSum, Pairs, compiled_sums
from eddies.particles.particle_set import as_numpy
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.smoothing_kernels import HermiteKernel, SmoothingKernel, over_distance

# Number of pairs evaluated together where no gradient is recorded. Their values about fill the cache of a core.
PAIRS_TOGETHER = 1 << 16
# Number of pairs evaluated together in kriging, which has ten weights per pair. So many pairs belong to enough points
# to occupy all threads.
KRIGED_TOGETHER = 1 << 20
# Methods of reconstruction ("forms").
WORDS = {"average": "averages with the learned kernel", "kriging": "kriging among neighbours"}

log = logging.getLogger("eddies")


class ParticleField:
    """This rank's particles, the ghosts within `support` of its slab, and the grid points in the slab, on the host.

    Along each axis the grid has as many cells as all slabs together have planes. The grid points of this rank are
    numbered with x fastest and z slowest.

    Results are made of velocities relative to their mean over the particles, which is then added. So a mean velocity
    changes no result, also with a kernel whose sums are not normalised, and costs no precision.

    Parameters
    ----------
    decomposition : slabs that hold the particles.
    support : largest radius of the kernels to be used.
    position, velocity : (n, 3), owned particles.
    dtype : floating-point type of computations with pairs.
    """

    def __init__(self, decomposition: SlabDecomposition, support: float, position: Tensor, velocity: Tensor,
                 dtype: torch.dtype = torch.float32) -> None:
        self.decomposition, self.dtype, self.owned, self.support = decomposition, dtype, position, support
        self._box = PeriodicBox(decomposition.length, periodic_z=decomposition.size == 1)
        self.halo = HaloExchange(decomposition, as_numpy(position), support)
        self._position = with_ghosts(self.halo, position, positions=True)
        mean = mean_over_ranks(decomposition.comm, velocity.double())
        self._velocity, self._mean = with_ghosts(self.halo, velocity - mean.to(velocity)).to(dtype), mean.to(dtype)
        self.points = grid_points(decomposition, decomposition.planes)
        self._entries: Tensor | None = None
        self._latest: tuple[SmoothingKernel, Tensor] | None = None  # kernel and result of the last call of `volumes`

    @torch.no_grad()
    def volumes(self, kernel: SmoothingKernel) -> Tensor:
        """Return the volumes (s,) of all owned particles and ghosts; collective.

        The volume of particle i is 1 / sum_j W(x_i - x_j), including j = i. A kernel with a mean volume gives this
        volume to all particles. The result is kept until another kernel is given.
        """
        if kernel.mean_volume is not None:
            return self._velocity.new_full((len(self._position),), kernel.mean_volume)
        if self._latest is None or self._latest[0] is not kernel:
            sums = self._sums(kernel, "kernel-sum", 1, self._position, len(self.owned))[0]
            self._latest = kernel, with_ghosts(self.halo, 1 / (sums + kernel.value(sums.new_zeros(()))))
        return self._latest[1]

    def volumes_by_table(self, kernel: HermiteKernel) -> Tensor:
        """Return the same as `volumes`, for a tabulated kernel; collective, differentiable in the table.

        The method stores the factor of each table entry in each particle's sum of W: 8 bytes for each knot and
        particle. So it is fast if it is called with many tables of the same size, as in training.
        """
        if kernel.mean_volume is not None:
            return self.volumes(kernel)
        if self._entries is None or self._entries.shape[1] != len(kernel.table):
            neighbors = self._neighbors_of(self.owned)
            with torch.no_grad():
                self._entries = torch.cat([_table_sums(kernel, neighbors.pairs(self.owned, self._position, block,
                                                                               self.dtype))
                                           for block in neighbors.blocks(PAIRS_TOGETHER)])
        return with_ghosts(self.halo, 1 / (self._entries @ kernel.table))

    def on_grid(self, kernel: SmoothingKernel, volume: Tensor, rows: Tensor | slice) -> tuple[Tensor, Tensor]:
        """Return the average velocity (k, 3) and its gradient (k, 3, 3) at the grid points `rows` of this rank.

        `volume` (s,) is the result of `volumes`. Differentiable in the kernel and the volumes.
        """
        pairs = self._around.pairs(self.points, self._position, rows, self.dtype)
        velocity, gradient = reconstruct_with_gradient(kernel, pairs, volume, self._velocity)
        return velocity + self._mean, gradient

    # ---- methods of the compiled library, which record no gradient

    @torch.no_grad()
    def averaged(self, kernel: SmoothingKernel, receivers: Tensor) -> tuple[Tensor, Tensor]:
        """Return the average velocity (k, 3) at any points of this rank, and its gradient (k, 3, 3); collective.

        The gradient has the axes [point, component, direction].
        """
        columns = torch.cat([self.volumes(kernel).unsqueeze(1), self._velocity], dim=1)
        columns = torch.cat([columns.new_zeros(len(receivers), 4), columns])
        sums = self._sums(kernel, "kernel-average", 16, torch.cat([receivers, self._position]), len(receivers),
                          tuple(columns.T))
        factor = normalisation(kernel, sums[:1])
        average = sums[1:4] * factor
        gradient = (sums[7:].reshape(3, 3, -1) - average.unsqueeze(1) * sums[4:7]) * factor
        return average.T + self._mean, gradient.permute(2, 0, 1)

    @torch.no_grad()
    def averaged_on_grid(self, kernel: SmoothingKernel) -> Tensor:
        """Return the average velocity (m, 3) at all of this rank's grid points; collective. Faster than `averaged`."""
        slab, volume = self.decomposition, self.volumes(kernel)
        weighted = volume.unsqueeze(1) * torch.cat([torch.ones_like(volume).unsqueeze(1), self._velocity], dim=1)
        sums = torch.from_numpy(sums_on_grid(self._box, slab.planes, range(slab.start, slab.stop), _for_library(kernel),
                                             self._position.numpy(), weighted.numpy()))
        return sums[:, 1:] * normalisation(kernel, sums[:, :1]) + self._mean

    @torch.no_grad()
    def kriged(self, filter_width: float, receivers: Tensor) -> tuple[Tensor, Tensor]:
        """Interpolate the velocity (k, 3) and its gradient (k, 3, 3) by kriging with all neighbours within `support`.

        `eddies.particles.kriging.interpolated` has the formulas.
        """
        neighbors = self._neighbors_of(receivers)
        blocks = [interpolated(neighbors.pairs(receivers, self._position, block, self.dtype), self.support,
                               filter_width, self._velocity) for block in neighbors.blocks(KRIGED_TOGETHER)]
        velocity, gradient = map(torch.cat, zip(*blocks))
        return velocity + self._mean, gradient

    def _sums(self, kernel: SmoothingKernel, kind: str, components: int, position: Tensor, count: int,
              scalars: tuple[Tensor, ...] = ()) -> Tensor:
        """Return the library's sums of a `kind` over neighbours of the first `count` positions, (components, count)."""
        space = PairSpace(self._box.length, self._box.periodic_z, kernel.support, 1.0, 1.0, False)
        summand = CompiledSum(kind, _for_library(kernel), scalars=scalars, reads_velocity=False)
        sums, = compiled_sums(space, [summand], [torch.ones(components)], position, None,
                              np.arange(len(position)) < count, self.dtype)
        return sums[:, :count]

    # ---- neighbours

    @cached_property
    def _around(self) -> NeighborList:
        """Neighbour list of the particles around the grid points."""
        return self._neighbors_of(self.points)

    def _neighbors_of(self, receivers: Tensor) -> NeighborList:
        neighbors = NeighborList(self._box, self.support, 0.0)
        neighbors.build(receivers, self._position, exclude_self=False)
        return neighbors


@dataclass(frozen=True)
class Form:
    """A way to reconstruct the velocity from the particles within the support of the kernel.

    Parameters
    ----------
    name : "average", Eqs. 5 and 6; or "kriging", the best linear estimate for the covariance of filtered turbulence.
    kernel : the learned kernel W. Only the form "average" accepts a W with negative values.
    filter_width : d of the filter that the velocities have passed.
    """

    name: str
    kernel: SmoothingKernel
    filter_width: float

    @property
    def words(self) -> str:
        return WORDS[self.name]

    @property
    def support(self) -> float:
        return self.kernel.support

    def at(self, field: ParticleField, points: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruct the velocity (k, 3) and its gradient (k, 3, 3) [component, direction] at points (k, 3) of this
        rank, from the particles of `field`; collective.

        The average replaces kriging at points that have too many neighbours or singular equations."""
        if self.name == "average":
            return field.averaged(self.kernel, points)
        velocity, gradient = field.kriged(self.filter_width, points)
        solved = velocity.isfinite().all(1) & gradient.isfinite().all(2).all(1)
        failed = torch.nonzero(~solved).squeeze(1)
        count, total = global_sum(field.decomposition.comm, np.array([len(failed), len(points)]))
        if count:  # on any rank: averages are collective
            log.warning("kriging: %d of %d points have too many neighbours or singular equations; averages replace "
                        "kriging there", count, total)
            velocity[failed], gradient[failed] = field.averaged(self.kernel, points[failed])
        return velocity, gradient

    def on_grid(self, field: ParticleField) -> Tensor:
        """Reconstruct the velocity (m, 3) at this rank's grid points, z slowest, from the particles of `field`;
        collective."""
        if self.name == "average":
            return field.averaged_on_grid(self.kernel)
        return self.at(field, field.points)[0]


def grid_points(slab: SlabDecomposition, cells: int) -> Tensor:
    """Return the points (m, 3) of a grid of `cells`^3 points that lie in this slab, with x fastest and z slowest."""
    axis = torch.arange(cells, dtype=torch.float64) * (slab.length / cells)
    # The limits are found in integers: rounded coordinates would assign points on the faces of slabs arbitrarily.
    first, end = (-(-plane * cells // slab.planes) for plane in (slab.start, slab.stop))
    z, y, x = torch.meshgrid(axis[first:end], axis, axis, indexing="ij")
    return torch.stack([x.flatten(), y.flatten(), z.flatten()], dim=1)


def _for_library(kernel: SmoothingKernel) -> tuple[float, ...]:
    """Return the kernel in the form of the compiled library."""
    return kernel_numbers(kernel.support, kernel.pieces.numpy(), kernel.mean_volume is not None)


def _table_sums(kernel: HermiteKernel, pairs: Pairs) -> Tensor:
    """Return the factor of each table entry in sum_j W(x_i - x_j) of each receiver i: (count, entries)."""
    entries, factors = kernel.in_table(pairs.distance)
    total = len(kernel.table)
    sums = pairs.distance.new_zeros(pairs.count * total)
    return sums.index_add_(0, (entries + pairs.segment * total).flatten(), factors.flatten()).reshape(-1, total)


# ---- kernel averages by torch


def volumes(kernel: SmoothingKernel, pairs: Pairs) -> Tensor:
    """Return the volume 1 / (W(0) + sum_j W(x_i - x_j)) of each particle i, (count,), or the kernel's mean volume.

    `pairs` must not pair a particle with itself: W(0) already counts the particle.
    """
    if kernel.mean_volume is not None:
        return pairs.distance.new_full((pairs.count,), kernel.mean_volume)
    at_centre = kernel.value(pairs.distance.new_zeros(1))
    return 1 / (at_centre + pairs.sum(kernel.value(pairs.distance)[None])[0])


def reconstruct(kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor) -> Tensor:
    """Return <A>(x) = sum_j V_j A_j W(x - x_j) / sum_j V_j W(x - x_j) at the receivers x, (count, components).

    A kernel with a mean volume gives the numerator alone, Eq. 6. The result is zero where no particle lies within the
    support. The volumes V (s,) and values A (s, components) are those of all local particles. A particle that is a
    receiver must be among its own neighbours.
    """
    return _average(kernel, pairs, pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T)[0].T


def reconstruct_with_gradient(kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor,
                              sender_values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the result of `reconstruct`, and its gradient (count, components, 3) with the direction as the last axis.

    The gradient sum_j V_j (A_j - <A>) grad W(x - x_j) / sum_j V_j W is exactly the gradient of the average.
    """
    volume, value, distance = pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T, pairs.distance
    average, factor = _average(kernel, pairs, volume, value)
    gradient = volume * over_distance(kernel.derivative(distance), distance) * pairs.displacement.T
    products = (value - average.index_select(1, pairs.segment)).unsqueeze(1) * gradient
    sums = pairs.sum(products.flatten(0, 1)) * factor
    return average.T, sums.unflatten(0, products.shape[:2]).permute(2, 0, 1)


def normalisation(kernel: SmoothingKernel, denominator: Tensor) -> Tensor:
    """Return 1 / denominator, or zero where no particle contributes; 1 for a kernel with a mean volume."""
    if kernel.mean_volume is not None:
        return torch.ones_like(denominator)
    empty = denominator == 0
    return torch.where(empty, torch.zeros_like(denominator), 1 / torch.where(empty, 1, denominator))


def _average(kernel: SmoothingKernel, pairs: Pairs, volume: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Return the average (components, count) and its `normalisation` (1, count).

    `volume` (m,) and `value` (components, m) are those of the sender of each pair.
    """
    weight = volume * kernel.value(pairs.distance)
    sums = pairs.sum(torch.cat([weight.unsqueeze(0), weight * value]))
    factor = normalisation(kernel, sums[:1])
    return sums[1:] * factor, factor
