"""Density from the pressure that keeps the particles' velocity solenoidal: no density equation, no sound."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.halo import HaloError, HaloExchange
from eddies.parallel.reduction import any_rank, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.ghosts import exchange_ghosts
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.rank_sums import mean_over_ranks
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.particles.surroundings import LocalParticles, Surroundings


class GridSolver(Protocol):
    """What the closure needs of a grid: its points, and what it makes of a field there at the particles, both with
    their adjoints (see `flow.pressure.PressureSolver`)."""

    points: np.ndarray
    decomposition: SlabDecomposition
    reach: float

    def velocity_at(self, field: np.ndarray, positions: np.ndarray) -> np.ndarray: ...

    def velocity_adjoint(self, field: np.ndarray, positions: np.ndarray, weights: np.ndarray) -> tuple: ...

    def pressure_at(self, field: np.ndarray, positions: np.ndarray) -> np.ndarray: ...

    def pressure_adjoint(self, field: np.ndarray, positions: np.ndarray, weights: np.ndarray) -> tuple: ...

    def band_energies(self, field: np.ndarray) -> np.ndarray: ...

    def band_energies_adjoint(self, field: np.ndarray, weights: np.ndarray) -> np.ndarray: ...

    def force_at(self, field: np.ndarray, positions: np.ndarray, factors: np.ndarray) -> np.ndarray: ...

    def force_adjoint(self, field: np.ndarray, positions: np.ndarray, factors: np.ndarray,
                      weights: np.ndarray) -> tuple: ...


@dataclass(frozen=True)
class ResolvedForce:
    """The force of a closure at fixed particles, as a function of the factors that are learned, if any are: constant
    (n, 3), terms (k, n, 3) or None."""

    constant: Tensor
    terms: Tensor | None
    factors: Callable[[], Tensor]

    def at(self, rows: Tensor | slice) -> Tensor:
        """The force (k, 3) on some of the particles; differentiable in the factors."""
        if self.terms is None:
            return self.constant[rows]
        return self.constant[rows] + torch.tensordot(self.factors().to(self.terms), self.terms[:, rows], 1)


class PoissonClosure:
    """rho = rho_0 (1 + p / c^2) with the pressure p of the resolved velocity of the particles.

    The velocity on the grid is a kernel average of the particles', which attenuates the smaller scales. So the
    average of what the grid field still misses at the particles is added to it, `passes` times in all: iterated
    (van Cittert) deconvolution. Where a point has no particle in reach the average is zero. So all velocities are
    taken relative to their mean over the particles: a void, too, looks the same from every frame of reference.

    Parameters
    ----------
    solver : the grid.
    kernel : weight of the average; its support is the reach of the closure.
    sound_speed : c. `density_mean` : rho_0.
    skin : extra radius of the list of particles around grid points.
    dtype : of the pair sums.
    factors : if given, the closure also gives a force, and this its factors (A, D_1, ..., D_m, C) in the units of the
        flow:  -grad p - A div(grad u grad u^T) - D(k) u  of the resolved velocity u, where D(k) is linear between D_1
        ... D_m (see `GridSolver.force_at`),  - C (v - u)  of what it misses, less the mean of all this over the
        particles, so that it keeps their momentum. It would be zero in continuous space, and is not where particles
        sample the grid unevenly.

    Differentiable in the particles' positions and velocities and in the factors. All ranks call it together. Raises
    HaloError, on all ranks, where a particle lies farther outside its slab than the grid reaches.
    """

    reads = ("velocity",)

    def __init__(self, solver: GridSolver, kernel: SmoothingKernel, sound_speed: float, density_mean: float = 1.0,
                 skin: float = 0.0, passes: int = 4, dtype: torch.dtype = torch.float32,
                 factors: Callable[[], Tensor] | None = None) -> None:
        self.solver, self.kernel, self.passes, self.skin = solver, kernel, passes, skin
        self.sound_speed, self.density_mean, self.factors = sound_speed, density_mean, factors
        self.cutoff, self.dtype = kernel.support, dtype
        self._points = torch.from_numpy(solver.points)
        self._list: NeighborList | None = None
        self._halo: HaloExchange | None = None

    @torch.no_grad()
    def apply(self, particles: ParticleSet) -> tuple[ParticleSet, ResolvedForce | None]:
        """The particles with the density of the closure, and the force if there is one; collective."""
        moving, field = self._resolved_velocity(particles, self._local(particles))
        if self.factors is None:
            pressure = _PressureAt.apply(field, particles.position, self.solver)[:, 0]
            return replace(particles, density=self._density(pressure, particles)), None
        with torch.enable_grad():
            factors = self.factors()
        learned = factors.requires_grad
        pressure, constant = self._pressure_and_force(moving, field, torch.zeros_like(factors) if learned else factors)
        terms = None
        if learned:
            units = torch.eye(len(factors), dtype=factors.dtype)
            terms = torch.stack([self._pressure_and_force(moving, field, unit)[1] - constant for unit in units])
        return replace(particles, density=self._density(pressure, particles)), ResolvedForce(constant, terms,
                                                                                             self.factors)

    def fields(self, particles: ParticleSet, local: LocalParticles) -> dict[str, Tensor]:
        """The "density" (n,) of the owned particles, and of a force the rate "velocity" (n, 3); collective."""
        moving, field = self._resolved_velocity(particles, local)
        if self.factors is None:
            pressure = _PressureAt.apply(field, particles.position, self.solver)[:, 0]
            return {"density": self._density(pressure, particles)}
        pressure, force = self._pressure_and_force(moving, field, self.factors())
        return {"density": self._density(pressure, particles), "velocity": force}

    def band_energies(self, particles: ParticleSet) -> Tensor:
        """Mean kinetic energy of the resolved velocity by bands of wavenumbers: (bands,); collective."""
        _, field = self._resolved_velocity(particles, self._local(particles))
        return _BandEnergies.apply(field, self.solver)

    def _density(self, pressure: Tensor, particles: ParticleSet) -> Tensor:
        return (self.density_mean * (1 + pressure / self.sound_speed**2)).to(particles.density)

    def _pressure_and_force(self, particles: ParticleSet, field: Tensor, factors: Tensor) -> tuple[Tensor, Tensor]:
        found = _ForceAt.apply(field, particles.position, factors[:-1], self.solver)
        force = found[:, 1:].to(particles.velocity)
        if factors[-1] != 0:
            resolved = _VelocityAt.apply(field, particles.position, self.solver).to(particles.velocity)
            force = force - factors[-1] * (particles.velocity - resolved)
        return found[:, 0], force - mean_over_ranks(self.solver.decomposition.comm, force)

    def _local(self, particles: ParticleSet) -> LocalParticles:
        """What this rank sees of the particles."""
        decomposition = self.solver.decomposition
        surroundings = Surroundings(decomposition, decomposition.length, 0.0, self.cutoff, self.skin)
        surroundings.update(particles)
        return surroundings.local(particles, set(self.reads))

    def _resolved_velocity(self, particles: ParticleSet, local: LocalParticles) -> tuple[ParticleSet, Tensor]:
        """The particles with velocities less their mean, and the velocity (m, 3) at the grid points whose resolved
        part is theirs, in double precision."""
        self._require_reach(particles.position)
        mean = mean_over_ranks(self.solver.decomposition.comm, particles.velocity)
        particles = replace(particles, velocity=particles.velocity - mean)
        pairs = self._pairs_around_points(local)
        weight = self.kernel.value(pairs.distance)
        weight = weight / pairs.sum(weight).clamp_min(torch.finfo(weight.dtype).tiny).index_select(0, pairs.segment)
        missing, field = local.columns["velocity"] - mean, 0
        for remaining in reversed(range(self.passes)):
            average = pairs.sum((weight * pairs.at_senders(missing.to(weight.dtype)).T).T)
            field = field + average.double()
            if remaining:
                resolved = _VelocityAt.apply(field, particles.position, self.solver)
                owned = particles.velocity - resolved.to(particles.velocity)
                missing = torch.cat([owned, exchange_ghosts(local.halo, owned)])
        return particles, field

    def _require_reach(self, position: Tensor) -> None:
        slab = self.solver.decomposition
        if slab.size == 1:
            return
        z, reach = position[:, 2].detach(), self.solver.reach
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


class _VelocityAt(torch.autograd.Function):
    """`GridSolver.velocity_at` of a field (m, 3) at positions (n, 3)."""

    @staticmethod
    def forward(ctx, field: Tensor, position: Tensor, solver: GridSolver) -> Tensor:
        ctx.save_for_backward(field, position)
        ctx.solver = solver
        return torch.from_numpy(solver.velocity_at(as_numpy(field), as_numpy(position))).to(field.device)

    @staticmethod
    def backward(ctx, weights: Tensor) -> tuple[Tensor, Tensor, None]:
        return *_adjoint(ctx.solver.velocity_adjoint, *ctx.saved_tensors, weights), None


class _PressureAt(torch.autograd.Function):
    """`GridSolver.pressure_at` of a field (m, 3) at positions (n, 3)."""

    @staticmethod
    def forward(ctx, field: Tensor, position: Tensor, solver: GridSolver) -> Tensor:
        ctx.save_for_backward(field, position)
        ctx.solver = solver
        return torch.from_numpy(solver.pressure_at(as_numpy(field), as_numpy(position))).to(field.device)

    @staticmethod
    def backward(ctx, weights: Tensor) -> tuple[Tensor, Tensor, None]:
        return *_adjoint(ctx.solver.pressure_adjoint, *ctx.saved_tensors, weights), None


class _ForceAt(torch.autograd.Function):
    """`GridSolver.force_at` of a field (m, 3) at positions (n, 3), with factors (1 + m,)."""

    @staticmethod
    def forward(ctx, field: Tensor, position: Tensor, factors: Tensor, solver: GridSolver) -> Tensor:
        ctx.save_for_backward(field, position, factors)
        ctx.solver = solver
        found = solver.force_at(as_numpy(field), as_numpy(position), as_numpy(factors.double()))
        return torch.from_numpy(found).to(field.device)

    @staticmethod
    def backward(ctx, weights: Tensor) -> tuple[Tensor, Tensor, Tensor, None]:
        field, position, factors = ctx.saved_tensors
        by_field, by_position, by_factors = ctx.solver.force_adjoint(
            as_numpy(field), as_numpy(position), as_numpy(factors.double()), as_numpy(weights))
        return (*_tensors(by_field, field, by_position, position), torch.from_numpy(by_factors).to(factors), None)


class _BandEnergies(torch.autograd.Function):
    """`GridSolver.band_energies` of a field (m, 3), the same on all ranks."""

    @staticmethod
    def forward(ctx, field: Tensor, solver: GridSolver) -> Tensor:
        ctx.save_for_backward(field)
        ctx.solver = solver
        return torch.from_numpy(solver.band_energies(as_numpy(field))).to(field.device)

    @staticmethod
    def backward(ctx, weights: Tensor) -> tuple[Tensor, None]:
        # Each rank's loss depends on the energies, to which all ranks' fields contribute.
        (field,), solver = ctx.saved_tensors, ctx.solver
        together = global_sum(solver.decomposition.comm, as_numpy(weights))
        return torch.from_numpy(solver.band_energies_adjoint(as_numpy(field), together)).to(field), None


def _adjoint(apply, field: Tensor, position: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
    by_field, by_position = apply(as_numpy(field), as_numpy(position), as_numpy(weights))
    return _tensors(by_field, field, by_position, position)


def _tensors(by_field: np.ndarray, field: Tensor, by_position: np.ndarray, position: Tensor) -> tuple[Tensor, Tensor]:
    return torch.from_numpy(np.ascontiguousarray(by_field)).to(field), torch.from_numpy(by_position).to(position)
