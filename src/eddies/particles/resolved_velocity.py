"""The velocity that a grid resolves of the particles': averages, deconvolved, of which the solenoidal modes are
kept."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from eddies.parallel.halo import HaloError, HaloExchange
from eddies.parallel.reduction import any_rank
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.cloud import grid_points
from eddies.particles.fourier_grid import FourierGrid, Points
from eddies.particles.ghosts import exchange_ghosts
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rank_sums import mean_over_ranks, sum_over_ranks
from eddies.particles.smoothing_kernels import SmoothingKernel, WendlandC2
from eddies.particles.surroundings import LocalParticles, Surroundings

# Particles in an average, and the share of the Nyquist wavenumber up to which modes are resolved: the best of a trial
# on filtered turbulence (32^3 particles, four passes): error of -grad p at the particles 0.366 in `hit` and 0.343 in
# `hit-small`, against 0.415 and 0.365 of the exact filtered pressure gradient, and 0.377 and 0.350 with two passes.
# More passes gain less than 0.002; more neighbours smooth more and cost more.
NEIGHBORS, RESOLVED_SHARE, PASSES = 16, 7 / 8, 4
# Wavenumber shells in a band of the energy.
BAND = 2


@dataclass(frozen=True)
class ResolvedFlow:
    """The resolved velocity at one moment.

    Parameters
    ----------
    grid : of its modes.
    velocity : modes (3, kz, ky, kx), solenoidal, |k| <= `grid.resolved`.
    points : of the owned particles on the grid.
    relative_velocity : (n, 3), theirs less its mean over all particles.
    """

    grid: FourierGrid
    velocity: Tensor
    points: Points
    relative_velocity: Tensor

    def at_particles(self, modes: Tensor) -> Tensor:
        """Values (n, c) of modes (c, kz, ky, kx) at the particles; collective, differentiable."""
        return self.grid.at(modes, self.points)

    def missing(self) -> Tensor:
        """What the grid does not resolve of the particles' velocities relative to their mean: (n, 3); collective."""
        return self.relative_velocity - self.at_particles(self.velocity).to(self.relative_velocity)


class ResolvedVelocity:
    """Makes a `ResolvedFlow` of particles.

    The velocity on the grid is a kernel average of the particles', which attenuates the smaller scales. So the average
    of what the grid still misses at the particles is added to it, `passes` times in all: iterated (van Cittert)
    deconvolution. Only solenoidal modes count: with a divergence, which scattered particles always leave in a field
    made of them, the pressure would depend on the mean velocity, and oscillate with it faster than particles can be
    stepped. Where a point has no particle in reach the average is zero. So all velocities are taken relative to their
    mean over the particles: a void, too, looks the same from every frame of reference.

    Products of modes above a third of the number of cells alias; for fields known from particles that is far below the
    error of the highest modes themselves.

    Parameters
    ----------
    grid : where the velocity is resolved.
    kernel : weight of the average; its support is the `reach` to other particles.
    skin : extra radius of the list of particles around grid points.
    dtype : of the pair sums.

    Differentiable in the particles' positions and velocities. All ranks call it together. Raises HaloError, on all
    ranks, where a particle lies farther outside its slab than the grid reaches.
    """

    def __init__(self, grid: FourierGrid, kernel: SmoothingKernel, skin: float = 0.0, passes: int = PASSES,
                 dtype: torch.dtype = torch.float32) -> None:
        self.grid, self.kernel, self.skin, self.passes, self.dtype = grid, kernel, skin, passes, dtype
        self.reach = kernel.support
        self._points = grid_points(grid.decomposition)
        self._list: NeighborList | None = None
        self._halo: HaloExchange | None = None

    @classmethod
    def on_slabs(cls, decomposition: SlabDecomposition, dtype: torch.dtype, skin: float = 0.0,
                 drift: float = 0.0) -> ResolvedVelocity:
        """On a grid of one cell for each plane of the slabs, and as many particles.

        `drift` is how far particles may move beyond half the skin before they change rank.
        """
        support = decomposition.spacing * (NEIGHBORS / (4 / 3 * math.pi)) ** (1 / 3)
        margin = max(math.ceil((skin / 2 + drift) / decomposition.spacing), 1)
        grid = FourierGrid(decomposition, int(RESOLVED_SHARE * decomposition.planes / 2), margin)
        return cls(grid, WendlandC2(support), skin, dtype=dtype)

    def of(self, particles: ParticleSet, local: LocalParticles) -> ResolvedFlow:
        """The resolved flow of particles and what this rank sees around them."""
        self._require_reach(particles.position)
        mean = mean_over_ranks(self.grid.decomposition.comm, particles.velocity)
        relative = particles.velocity - mean
        pairs = self._pairs_around_points(local)
        weight = self.kernel.value(pairs.distance)
        weight = weight / pairs.sum(weight).clamp_min(torch.finfo(weight.dtype).tiny).index_select(0, pairs.segment)
        points = self.grid.points(particles.position)
        missing, modes = self._with_ghosts(relative, local), 0
        for remaining in reversed(range(self.passes)):
            average = pairs.sum((weight * pairs.at_senders(missing.to(weight.dtype)).T).T)
            modes = modes + self._resolved_modes(average)
            if remaining:
                found = self.grid.at(modes, points)
                missing = self._with_ghosts(relative - found.to(relative), local)
        return ResolvedFlow(self.grid, modes, points, relative)

    def alone(self, particles: ParticleSet) -> ResolvedFlow:
        """The same of particles whose surroundings are not known."""
        decomposition = self.grid.decomposition
        surroundings = Surroundings(decomposition, decomposition.length, 0.0, self.reach, self.skin)
        surroundings.update(particles)
        return self.of(particles, surroundings.local(particles))

    def band_energies(self, particles: ParticleSet) -> Tensor:
        """Mean kinetic energy <u.u>/2 of the resolved velocity by bands of `BAND` wavenumber shells, from shell 1 on:
        (bands,), over all ranks; collective, differentiable."""
        grid, modes = self.grid, self.alone(particles).velocity
        energy = 0.5 * grid.multiplicity * (modes.real.square() + modes.imag.square()).sum(0)
        shell = torch.round(grid.shell).long()
        inside = (shell > 0) & (shell <= grid.resolved)
        bands = energy.new_zeros((grid.resolved - 1) // BAND + 1)
        return sum_over_ranks(grid.decomposition.comm,
                              bands.index_add(0, (shell[inside] - 1) // BAND, energy[inside]))

    def _resolved_modes(self, average: Tensor) -> Tensor:
        """The resolved modes of a velocity (m, 3) at the grid points."""
        fields = average.double().cpu().T.reshape(3, *self.grid.spectral.physical_shape)
        return self.grid.solenoidal(self.grid.within(self.grid.to_modes(fields)))

    def _with_ghosts(self, owned: Tensor, local: LocalParticles) -> Tensor:
        return torch.cat([owned, exchange_ghosts(local.halo, owned)])

    def _require_reach(self, position: Tensor) -> None:
        slab = self.grid.decomposition
        if slab.size == 1:
            return
        z, reach = position[:, 2].detach(), self.grid.reach
        if any_rank(slab.comm, bool(((z < slab.lower - reach) | (z >= slab.upper + reach)).any())):
            raise HaloError(f"a particle moves more than {reach:.3g} out of its slab before it can change rank, and "
                            "the ghost planes reach no farther: shorten the time step or the skin")

    def _pairs_around_points(self, local: LocalParticles) -> Pairs:
        # Ghosts, and with them the rows of the list, belong to one halo.
        if local.halo is not self._halo:
            self._points = self._points.to(local.position.device)
            self._list = NeighborList(local.box, self.reach, self.skin)
            self._list.build(self._points, local.position, exclude_self=False)
            self._halo = local.halo
        return self._list.pairs(self._points, local.position, dtype=self.dtype)
