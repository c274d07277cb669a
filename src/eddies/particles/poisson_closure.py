"""Density from the pressure that keeps the particles' velocity solenoidal: no density equation, no sound."""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.halo import HaloError, HaloExchange
from eddies.parallel.reduction import any_rank
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.ghosts import exchange_ghosts
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.particles.surroundings import LocalParticles, Surroundings


class GridSolver(Protocol):
    """What the closure needs of a grid: its points, and fields carried between them and the particles."""

    points: np.ndarray
    decomposition: SlabDecomposition
    reach: float

    def modes(self, values: np.ndarray) -> np.ndarray: ...

    def velocity_at(self, modes: np.ndarray, positions: np.ndarray) -> np.ndarray: ...

    def pressure_at(self, modes: np.ndarray, positions: np.ndarray) -> np.ndarray: ...


class PoissonClosure:
    """rho = rho_0 (1 + p / c^2) with the pressure p of the resolved velocity of the particles.

    The velocity on the grid is a kernel average of the particles', which attenuates the smaller scales. So the
    average of what the grid field still misses at the particles is added to it, `passes` times in all: iterated
    (van Cittert) deconvolution.

    Parameters
    ----------
    solver : the grid.
    kernel : weight of the average; its support is the reach of the closure.
    sound_speed : c. `density_mean` : rho_0.
    skin : extra radius of the list of particles around grid points.
    dtype : of the pair sums.

    Has no gradient: it is evaluated outside of recorded operations. All ranks call it together. Raises HaloError, on
    all ranks, where a particle lies farther outside its slab than the grid reaches.
    """

    reads = ("velocity",)

    def __init__(self, solver: GridSolver, kernel: SmoothingKernel, sound_speed: float, density_mean: float = 1.0,
                 skin: float = 0.0, passes: int = 4, dtype: torch.dtype = torch.float32) -> None:
        self.solver, self.kernel, self.passes, self.skin = solver, kernel, passes, skin
        self.sound_speed, self.density_mean = sound_speed, density_mean
        self.cutoff, self.dtype = kernel.support, dtype
        self._points = torch.from_numpy(solver.points)
        self._list: NeighborList | None = None
        self._halo: HaloExchange | None = None

    @torch.no_grad()
    def apply(self, particles: ParticleSet) -> ParticleSet:
        """The particles with the density of the closure; collective."""
        decomposition = self.solver.decomposition
        surroundings = Surroundings(decomposition, decomposition.length, 0.0, self.cutoff, self.skin)
        surroundings.update(particles)
        return replace(particles, density=self.density(particles, surroundings.local(particles, set(self.reads))))

    @torch.no_grad()
    def density(self, particles: ParticleSet, local: LocalParticles) -> Tensor:
        """Density (n,) of the owned particles; collective."""
        self._require_reach(particles.position)
        modes = self._resolved_velocity(particles, local)
        pressure = self.solver.pressure_at(modes, as_numpy(particles.position))
        density = self.density_mean * (1 + pressure / self.sound_speed**2)
        return torch.from_numpy(density).to(particles.density)

    def _resolved_velocity(self, particles: ParticleSet, local: LocalParticles) -> np.ndarray:
        pairs = self._pairs_around_points(local)
        weight = self.kernel.value(pairs.distance)
        weight = weight / pairs.sum(weight).clamp_min(torch.finfo(weight.dtype).tiny).index_select(0, pairs.segment)
        velocity, position = particles.velocity, as_numpy(particles.position)
        missing, modes = local.columns["velocity"], 0
        for remaining in reversed(range(self.passes)):
            average = pairs.sum((weight * pairs.at_senders(missing.to(weight.dtype)).T).T)
            modes = modes + self.solver.modes(as_numpy(average).astype(np.float64))
            if remaining:
                resolved = torch.from_numpy(self.solver.velocity_at(modes, position)).to(velocity)
                owned = velocity - resolved
                missing = torch.cat([owned, exchange_ghosts(local.halo, owned)])
        return modes

    def _require_reach(self, position: Tensor) -> None:
        slab = self.solver.decomposition
        if slab.size == 1:
            return
        z, reach = position[:, 2], self.solver.reach
        if any_rank(slab.comm, bool(((z < slab.lower - reach) | (z >= slab.upper + reach)).any())):
            raise HaloError(f"a particle moves more than {reach:.3g} out of its slab before it can change rank, and "
                            "the ghost planes reach no farther: shorten the time step or the skin")

    def _pairs_around_points(self, local: LocalParticles) -> Pairs:
        # Ghosts, and with them the rows of the list, belong to one halo.
        if local.halo is not self._halo:
            self._points = self._points.to(local.position.device)
            self._list = NeighborList(local.box, self.cutoff, self.skin)
            self._list.build(self._points, local.position, exclude_self=False)
            self._halo = local.halo
        return self._list.pairs(self._points, local.position, dtype=self.dtype)
