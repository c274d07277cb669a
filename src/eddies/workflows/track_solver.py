"""Least squares for measured particles. Cross-validation finds the weight of the noise."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.error_samples import mixed
from eddies.particles.exchanges import fluctuations, mean_over_ranks, relative_error
from eddies.particles.flow_units import CELLS_PER_WAVENUMBER, ReferenceScales, planes_for, resolved_wavenumber
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.remembered_velocity import RememberedVelocity
from eddies.particles.resolved_velocity import TOLERANCE, WEIGHT, ResolvedVelocity
from eddies.scene.scene import BOX_LENGTH, Reconstruction, Tracers

WEIGHTS = 10.0 ** np.arange(3, -1.1, -0.5)  # weights of the noise in least squares; cross-validation chooses one
RISE = 1.02             # the search ends when the error exceeds the least error by this factor
HELD_OUT = 0.1          # share of the particles that cross-validation leaves out
# Residual of a solve for filtered tracks, relative to the velocities. With TOLERANCE, that of other tracks, errors of
# 8^3, 16^3 and 32^3 filtered tracks of hit-small without noise are 3, 17 and 33 % larger, with 1e-5 1 to 4 % smaller.
RESIDUAL_FILTERED = 5e-5
NO_FILTER = 1e-3        # filter width divided by the spacing, for an unfiltered flow


class Method(Protocol):
    """Computes the modes (3, kz, ky, kx) of the particles' velocity, frame by frame."""

    def of(self, particles: ParticleSet, time: float) -> Tensor:
        """Return the modes at a time; collective."""

    def state_dict(self) -> dict[str, Any]:
        """Return what the next frame needs from earlier frames: tensors of modes, and plain values."""
        return {}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`."""


class UniformMethod(Method):
    """Gives the modes of a velocity that is the same at all particles."""

    def __init__(self, solver: ResolvedVelocity) -> None:
        self._grid = solver.grid

    def of(self, particles: ParticleSet, time: float) -> Tensor:
        mean = mean_over_ranks(self._grid.decomposition.comm, particles.velocity)
        return self._grid.with_mean(self._grid.zeros(3), mean)


class LeastSquaresMethod(Method):
    """Fits the modes to each frame alone by least squares. The solve starts from the modes of the previous frame."""

    def __init__(self, solver: ResolvedVelocity) -> None:
        self._solver = solver
        self._near: Tensor | None = None

    @torch.no_grad()
    def of(self, particles: ParticleSet, time: float) -> Tensor:
        self._near = self._solver.of(particles, near=self._near).modes
        return self._near

    def state_dict(self) -> dict[str, Any]:
        return {"modes": self._near}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        self._near = state["modes"]


def solving_method(settings: Reconstruction, solver: ResolvedVelocity, viscosity: float, transfer: Tensor,
                   weight: float) -> LeastSquaresMethod | RememberedVelocity:
    """Make the method "memory" or "least-squares" of [reconstruction].

    `transfer` is the transfer function of the filter that the particles' velocity has passed.
    """
    if settings.method == "memory":
        return RememberedVelocity(solver, viscosity, transfer, settings.memory, weight)
    return LeastSquaresMethod(solver)


def best_solver(particles: ParticleSet, make: Callable[[float], ResolvedVelocity], share: float = HELD_OUT,
                uniform: bool = False) -> tuple[ResolvedVelocity, float, float]:
    """Find the weight of the noise by cross-validation on a `share` of the particles that the solve leaves out.

    `make` makes the solver for a weight. Returns the best solver, its weight, and its error relative to the rms
    velocity. The best weight depends on the filter, the errors of measured velocities and the number of particles,
    none of which is known well. Weights are tried in descending order until the error exceeds the least one by 2 %. If
    there are too few particles to leave one out and to keep one, or if their velocities are `uniform`, the default
    weight is taken, and the error is NaN. Collective.
    """
    known, held_out = split(particles, share)
    default = make(WEIGHT)
    counts = global_sum(default.grid.decomposition.comm, np.array([len(known.id), len(held_out.id)]))
    if uniform or not counts.all():
        return default, WEIGHT, math.nan
    best: tuple[ResolvedVelocity, float, float] | None = None
    for weight in WEIGHTS.tolist():
        solver = make(weight)
        with torch.no_grad():
            error = validation_error(solver, solver.of(known).modes, held_out)
        if best is None or error < best[2]:
            best = solver, weight, error
        if error > RISE * best[2]:
            break
    return best


def split(particles: ParticleSet, share: float) -> tuple[ParticleSet, ParticleSet]:
    """Split particles by id into the known ones and a `share` that is left out; the same on any number of ranks."""
    held_out = torch.from_numpy(mixed(as_numpy(particles.id)) < np.uint64(share * 2.0**64))
    known, held = (ParticleSet(particles.id[rows], particles.position[rows], particles.velocity[rows])
                   for rows in (~held_out, held_out))
    return known, held


def validation_error(solver: ResolvedVelocity, modes: Tensor, held_out: ParticleSet) -> float:
    """Return the `relative_error` of a velocity, given by its modes, at the particles that were left out.

    The result is NaN if there are none. Collective.
    """
    comm = solver.grid.decomposition.comm
    missed = solver.grid.at(modes, solver.grid.points(held_out.position)) - held_out.velocity
    return relative_error(comm, missed, fluctuations(comm, held_out.velocity))


def slabs_for(comm: Comm, tracers: Tracers, resolved: Tracers, filter_width: float,
              kolmogorov_length: float) -> SlabDecomposition:
    """Return the slabs of a grid for the modes that the tracers `resolved` would resolve.

    If the spectrum of the flow ends at lower wavenumbers, the grid has fewer planes, but at least as many as for
    `tracers`.
    """
    highest = resolved_wavenumber(resolved.spacing, filter_width, kolmogorov_length)
    planes = 2 * math.ceil(CELLS_PER_WAVENUMBER / 2 * highest)
    least, most = planes_for(tracers.particles), planes_for(resolved.particles)
    return SlabDecomposition(comm, BOX_LENGTH, min(max(planes, least), most))


def solver_of(slab: SlabDecomposition, reference: Mapping[str, float], periods: Sequence[int], filtered: bool,
              weight: float) -> ResolvedVelocity:
    """Make the least-squares solver with this weight of the noise. Each solve ends at the same residual.

    `reference` holds the reference scales, with the names that they have in ground_truth.h5. The solver does not depend
    on those of velocity and acceleration, which may be 0. `periods` are those of the flow in the box. `filtered` tells
    whether the tracks follow a filtered velocity.
    """
    scales = ReferenceScales(
        velocity=1.0, acceleration=1.0,
        **{name: reference[name] for name in ("filter_width", "spacing", "density_mean", "viscosity",
                                              "kolmogorov_length")})
    solver = ResolvedVelocity.on_slabs(slab, scales, weight=weight, periods=periods)
    solver.tolerance = solver.tolerance_predicted = RESIDUAL_FILTERED if filtered else TOLERANCE
    return solver


def particles_on(slab: SlabDecomposition, columns: Mapping[str, np.ndarray]) -> ParticleSet:
    """Make particles of rows that any rank holds, and move them to the ranks of their slabs; collective."""
    return ParticleSet.from_numpy(migrate(slab, dict(columns)))
