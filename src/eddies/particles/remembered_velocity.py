"""A resolved velocity with memory: the mean of its prior is based on a forecast from the previous moment."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.reduction import global_sum
from eddies.particles.least_squares import LeastSquares
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity

ANGLE = 0.5  # upper limit of u' k_c dt in a substep dt of the forecast
# Time for which a flow follows its forecasts, over the `memory` of the estimate. It was chosen by trials of the error
# map with the default memory; docs/tracks.md has the shares of errors within the standard deviations.
FAITH = 5.0


@dataclass
class RememberedVelocity:
    """Estimates the resolved velocity frame by frame, with a forecast from each frame to the next.

    The correlation of a mode with its forecast f is assumed to decay in a time dt to beta = exp(-k u' dt / 2C), where
    u' is the rms of a component of the velocity before the filter. The prior then has the mean beta f and the variance
    beta^2 V + (1 - beta^2) P, where P is the prior variance in the solver and V the variance of the previous estimate.
    For N evenly spread particles, 1/V = N/e + 1/(variance of the previous prior). e is the energy of a velocity
    component that the solver expects beyond its modes. So modes that few particles determine collect the information
    of several frames. Forecasts solve the Navier-Stokes equations for the velocity before the filter, in the modes of
    the solver. The zeroth mode has no prior: each frame determines it.

    Parameters
    ----------
    solver : estimates the first frame, which has no forecast. Its grid, prior and tolerance serve all frames.
    viscosity : kinematic viscosity nu.
    transfer : G (kz, ky, kx), transfer function of the filter that the particles' velocity has passed; 1 without one.
    memory : C; the larger it is, the longer a forecast counts.
    weight : factor of the noise in the solver, sigma^2 / e. If it is below 1, N/sigma^2 replaces N/e in 1/V.

    All methods are collective.
    """

    solver: ResolvedVelocity
    viscosity: float
    transfer: Tensor
    memory: float
    weight: float = 1.0

    def __post_init__(self) -> None:
        self._latest: tuple[float, Tensor] | None = None
        self._penalty = self.solver.equations.penalty  # sigma^2 over the variance of the latest prior
        self._count = 0.0
        #: the equations of the latest moment
        self.equations = self.solver.equations
        #: phase k_c u' dt by which the flow carries the highest modes between the latest two moments; 0 before
        self.angle = 0.0
        self._prior: _Prior | None = None

    @torch.no_grad()
    def of(self, particles: ParticleSet, time: float) -> Tensor:
        """Estimate the modes (3, kz, ky, kx) of the velocity that particles resolve.

        `time` must be later than in the previous call.
        """
        grid, comm, count = self.solver.grid, self.solver.grid.decomposition.comm, len(particles.velocity)
        if self._latest is None:
            modes = self.solver.of(particles).modes
            count = global_sum(comm, count)
        else:
            before, latest = self._latest
            mean, latest, step = grid.mean(latest), grid.without_mean(latest), time - before
            count, square = global_sum(comm, np.array([count, float((particles.velocity - mean).square().sum())]))
            shift = step * self._speed(latest / self.transfer)
            self.angle = shift * grid.highest
            worth = torch.exp(-shift * grid.wavenumber_squared.sqrt() / (2 * self.memory))
            points = grid.points(particles.position)
            self._penalty = self._next_penalty(worth)
            self.equations = LeastSquares(grid, self.solver.equations.inside, self._penalty)
            self._prior = _Prior(latest, self.forecast(latest, step), step, mean, worth)
            prior = grid.with_mean(worth * self.solver.advected(self._prior.forecast, step, mean), mean)
            missing = particles.velocity - grid.at(prior, points)
            right = self.equations.descent(missing, points, torch.zeros_like(prior))
            change = self.equations.solve(points, right, count, self.solver.tolerance**2 * square, None,
                                          self.solver.most_iterations)
            modes = prior + change.modes
        self._latest, self._count = (time, modes), float(count)
        return modes

    def deviation(self, error: Tensor, random: Tensor) -> Tensor:
        """Return how far a possible flow is from the mean of the latest prior.

        `error` e are the modes of the previous estimate u minus the flow, and `random` are modes drawn from the prior P
        of the solver. The result is gamma F(u - e) - beta F(u) + (1 - gamma^2)^(1/2) `random` with the forecast F and
        gamma = beta^(1/5): flows follow their forecasts for longer than the estimate counts these. The mean over the
        box has no prior and is left out. Collective.
        """
        latest, forecast, step, mean, worth = self._prior
        follows = worth ** (1 / FAITH)
        changed = follows * self.forecast(latest - self.solver.grid.without_mean(error), step) - worth * forecast
        return self.solver.advected(changed, step, mean) + (1 - follows**2).sqrt() * random

    def state_dict(self) -> dict[str, Any]:
        """State for the next moment; empty before the first. `modes` and `penalty` are tensors of the latest estimate.
        `time` and the number of particles `count` are plain values."""
        if self._latest is None:
            return {}
        time, modes = self._latest
        return {"modes": modes, "penalty": self._penalty, "time": time, "count": self._count}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`."""
        if state:
            self._latest = state["time"], state["modes"]
            self._penalty, self._count = state["penalty"], state["count"]

    def forecast(self, modes: Tensor, step: float) -> Tensor:
        """Return the modes, with mean zero, after the time `step`, by Runge-Kutta substeps of fourth order, in which
        the viscous decay is exact (an integrating factor), so that no viscosity limits a substep."""
        whole = modes / self.transfer
        steps = max(math.ceil(step * self.solver.grid.highest * self._speed(whole) / ANGLE), 1)
        dt = step / steps
        decay = torch.exp(-self.viscosity * dt / 2 * self.solver.grid.wavenumber_squared)  # of half a substep
        for _ in range(steps):
            half = decay * whole
            first = self._advection(whole)
            second = self._advection(half + dt / 2 * decay * first)
            third = self._advection(half + dt / 2 * second)
            last = self._advection(decay * (half + dt * third))
            whole = decay * (half + dt / 6 * (decay * first + 2 * (second + third))) + dt / 6 * last
        return whole * self.transfer

    def _advection(self, whole: Tensor) -> Tensor:
        """Return P[-div(uu)] for the modes `whole` of the velocity u before the filter."""
        grid = self.solver.grid
        return -self.solver.equations.projected(grid.stress_divergence(grid.squares(whole)))

    def _next_penalty(self, worth: Tensor) -> Tensor:
        """Return sigma^2 divided by the variance of the next prior. `worth` is beta."""
        first = self.solver.equations.penalty
        before, limited = max(self.weight, 1.0) * self._count + self._penalty, first > 0
        variance = worth**2 / before + (1 - worth**2) / torch.where(limited, first, 1.0)
        return torch.where(limited, 1 / variance, 0.0)

    def _speed(self, modes: Tensor) -> float:
        """Return the rms u' of a component of the velocity with these modes; collective."""
        return math.sqrt(float(self.solver.grid.mean_square(modes)) / 3)


class _Prior(NamedTuple):
    """What the prior of a moment is made of: the previous estimate without its mean, its forecast after a time `step`,
    its `mean`, with which it moves, and `worth`, beta of each mode."""

    latest: Tensor
    forecast: Tensor
    step: float
    mean: Tensor
    worth: Tensor
