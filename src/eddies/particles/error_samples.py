"""Random errors of a velocity that least squares estimate: samples of the Gaussian posterior."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.reduction import global_sum
from eddies.particles.fourier_grid import FourierGrid, Points
from eddies.particles.least_squares import LeastSquares, Solution
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.remembered_velocity import RememberedVelocity
from eddies.particles.resolved_velocity import ResolvedVelocity

# Final residual of the solve for an error, relative to its right-hand side. Errors of large scales come from scales
# that the particles alias, and appear last: with 3e-2 they are up to four times too small.
TOLERANCE = 4e-3
# Number of draws that measure the levels of prior and noise. Each averages over all particles and modes.
DRAWS = 4
# Weights of frames that are independent. Others reach to where a phase turns by CARRIED, or for MOST_CARRIED frames.
ALONE, CARRIED, MOST_CARRIED = (1.0,), 2.0, 8
# Shifts and factors that mix all 64 bits of an id (the finaliser of splitmix64; Steele, Lea and Flood 2014). Ids of
# tracks may have any pattern, such as the number of a camera in their upper bits.
MIXING = ((30, 0xbf58476d1ce4e5b9), (27, 0x94d049bb133111eb), (31, 1))


class ErrorSamples:
    """Draws errors e = u_estimate - u of the least squares

        minimise  sum_i |v_i - u(x_i)|^2 + sum_k penalty_k |u(k) - f(k)|^2.

    If the flow is f + w with random modes w, and the velocities are v = B(f + w) + n with random noise n, the minimum
    has the error that solves

        A e = P B^T n - penalty w,    A = P B^T B + penalty.

    With the variances that the penalty assumes, these are samples of the posterior. Here the variances are those that
    the data show, so the errors are honest also where the penalty was chosen for another reason. The noise n stands for
    `UnresolvedScales` and, for velocities of splines, for errors of the velocities.

    **Levels.** The prior's variance is c / penalty, and the noise has the variance s^2. Both sums of the minimum, the
    misfit and the penalty, have expected values that are linear in c and s^2. A few draws give the coefficients, and
    the minimum of one frame gives c and s^2. In other frames c and s^2 follow the mean square of the velocities.

    **Smoothed tracks.** Velocities of splines have errors that are known in each frame. What is left of the noise of
    positions is a part of s^2: the level is that of the rest, and each frame adds its own part. Successive velocities
    of a track share the noise of positions, so their errors are drawn from the same random positions. What smoothing
    removes from the motion is alike at neighbours, so it is no noise of the solve. It is drawn as a velocity with the
    prior's spectrum, and its level is never measured, since the estimate follows it.

    **Memory.** Each sample follows the estimate from frame to frame: `RememberedVelocity.deviation` makes w from the
    previous error and new random modes, so the spread grows by the forecasts and shrinks by the data. The flow carries
    unresolved scales along, so theirs are as alike in two frames as modes that turn by random phases k_c u' dt.

    Random numbers belong to a frame, a sample, and an id or a plane of the grid, so they do not depend on the number of
    ranks. All methods are collective.

    Parameters
    ----------
    solver : estimates the velocity, or the first frame of a `memory`. Its penalty is the prior.
    count : number of samples.
    memory : the method that estimates the frames, if it has a memory.
    weights : `error_weights` of splines. Only a memory needs them: without one, frames are independent.
    every : number of frames from one estimate to the next.
    """

    def __init__(self, solver: ResolvedVelocity, count: int, memory: RememberedVelocity | None = None,
                 weights: Sequence[float] = ALONE, every: int = 1) -> None:
        self.solver, self.count, self.memory, self.every = solver, count, memory, every
        self.weights = weights if memory else ALONE
        #: c and s^2 without the noise of splines, over the mean square of the velocity fluctuations
        self.levels: np.ndarray | None = None
        self._errors: list[Tensor] = []

    @cached_property
    def _beyond(self) -> UnresolvedScales:
        return UnresolvedScales(self.solver)

    @torch.no_grad()
    def measure(self, particles: ParticleSet, noise: float = 0.0) -> None:
        """Measure the `levels` by the least squares of particles; `noise` is as in `of`."""
        modes = self.solver.of(particles).modes
        count, square = self._fluctuation(particles, modes, noise)
        prior, variance = self._measured_levels(particles, modes, self.solver.grid.points(particles.position), count)
        self.levels = np.array([prior, max(variance - noise**2, 0.0)]) / square if square > 0 else np.zeros(2)

    @torch.no_grad()
    def of(self, particles: ParticleSet, modes: Tensor, frame: int, noise: float = 0.0,
           smoothed: float = 0.0) -> Iterator[Tensor]:
        """Yield the modes (3, kz, ky, kx) of each error of the estimate `modes` in the frame with this number.

        `noise` and `smoothed` are rms errors of a velocity component, by splines: of what is left of the noise, and of
        what smoothing removes from the motion. Call this after the estimate, once in each frame, and use up the
        iterator. The first call measures the levels, if `measure` was not called.
        """
        if self.count == 0:
            return
        if self.levels is None:
            self.measure(particles, noise)
        grid, memory = self.solver.grid, self.memory
        equations, points = memory.equations if memory else self.solver.equations, grid.points(particles.position)
        count, square = self._fluctuation(particles, modes, noise)
        (prior, spread), ids = np.sqrt(self.levels * square), as_numpy(particles.id)
        carried = carried_weights(memory.angle / self.every) if memory else ALONE
        first = frame + MOST_CARRIED - len(carried) // 2  # so that the largest weight is that of the same draw
        errors, self._errors = self._errors, []
        for sample in range(self.count):
            deviation = prior * self._random_modes(frame, sample)
            if errors and memory:
                deviation = memory.deviation(errors[sample], deviation)
            random = spread * self._beyond.at(points, ids, first, sample, carried)
            if noise > 0:
                random += noise * normal(ids, frame, self.count + sample, self.weights)
            if smoothed > 0:
                alike = grid.at(self._random_modes(frame, self.count + sample), points)
                size = global_sum(grid.decomposition.comm, _square(alike)) / (3 * count)
                random += smoothed / math.sqrt(size) * alike
            error = self._error(equations, points, random, deviation, count).modes
            if memory:
                self._errors.append(error)
            yield error

    def state_dict(self) -> dict[str, Any]:
        """State for the next frame: the `levels`, and with a memory the modes of the latest `errors`."""
        plain = {"levels": None if self.levels is None else self.levels.tolist()}
        return {**plain, "errors": torch.cat(self._errors)} if self._errors else plain

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Inverse of `state_dict`."""
        self.levels = None if state["levels"] is None else np.array(state["levels"])
        self._errors = list(state["errors"].split(3)) if "errors" in state else []

    def _fluctuation(self, particles: ParticleSet, modes: Tensor, noise: float) -> tuple[float, float]:
        """Return the number of particles, and the mean square of a component of their velocity without its mean and its
        noise."""
        relative = particles.velocity - self.solver.grid.mean(modes)
        count, square = global_sum(self.solver.grid.decomposition.comm, np.array([len(relative), _square(relative)]))
        return count, max(square / (3 * count) - noise**2, 0.0)

    def _measured_levels(self, particles: ParticleSet, modes: Tensor, points: Points, count: float) -> np.ndarray:
        """Return c and s^2 with which the misfit and the penalty of the minimum have their expected values. They are 0
        if the particles move alike."""
        grid, equations = self.solver.grid, self.solver.equations
        sums = [np.array([_square(particles.velocity - grid.at(modes, points)), self._penalty_of(modes)])]
        for sample in range(DRAWS):
            flow = self._random_modes(0, sample)
            noise = self._beyond.at(points, as_numpy(particles.id), 0, sample)
            of_flow = self._error(equations, points, torch.zeros_like(noise), flow, count)
            of_noise = self._error(equations, points, noise, torch.zeros_like(flow), count)
            sums += [np.array([_square(of_flow.at_points), self._penalty_of(flow + of_flow.modes)]),
                     np.array([_square(noise - of_noise.at_points), self._penalty_of(of_noise.modes)])]
        found = global_sum(grid.decomposition.comm, np.stack(sums))
        return positive_solution(np.stack([found[1::2].mean(0), found[2::2].mean(0)], 1), found[0])

    def _error(self, equations: LeastSquares, points: Points, noise: Tensor, deviation: Tensor,
               count: float) -> Solution:
        right = equations.gathered(noise, points) - equations.penalty * deviation
        return equations.solve(points, right, count, TOLERANCE**2 * equations.size(right, count), None,
                               self.solver.most_iterations)

    def _random_modes(self, frame: int, sample: int) -> Tensor:
        """Return random modes (3, kz, ky, kx) with the variance 1 / penalty of both solenoidal components."""
        grid, equations = self.solver.grid, self.solver.equations
        penalty = equations.penalty
        return equations.projected(white_modes(grid, frame, sample)) * torch.where(
            penalty > 0, 1 / torch.where(penalty > 0, penalty, 1.0), 0.0).sqrt()

    def _penalty_of(self, modes: Tensor) -> float:
        """Return this rank's part of the sum of penalty |u|^2 over all modes."""
        weight = self.solver.grid.multiplicity * self.solver.equations.penalty
        return float((weight * (modes.real.square() + modes.imag.square()).sum(0)).sum())


class UnresolvedScales:
    """Random velocities of the scales beyond the modes of a solver. A component has the variance 1.

    The modes just beyond k_c pass for those just below it, so they disturb an estimate more than white noise does. As
    far as the grid holds them, they are a solenoidal velocity with the prior's spectrum; the rest is white noise.
    """

    def __init__(self, solver: ResolvedVelocity) -> None:
        slab, own = solver.grid.decomposition, solver.grid
        highest = (slab.planes - 1) // 2
        self.grid = grid = FourierGrid(slab, highest, round(own.reach / slab.spacing), own.dtype)
        inside = (grid.shell > own.resolved) & (grid.shell <= highest) & grid.repeating(solver.periods)
        #: share of the energy that is white noise
        self.white, self._amplitude = 1.0, None
        if global_sum(slab.comm, float(inside.sum())) > 0:
            energy, rest = solver.expected_energy(grid, inside)
            self.white = rest / solver.unresolved
            self._amplitude = (3 * (1 - self.white) * energy).sqrt()

    def at(self, points: Points, ids: np.ndarray, frame: int, sample: int,
           weights: Sequence[float] = ALONE) -> Tensor:
        """Return the velocities (n, 3) at points of the solver's grid; `weights` as in `white_modes`. Collective."""
        found = math.sqrt(self.white) * normal(ids, frame, sample, weights)
        if self._amplitude is None:
            return found
        modes = self.grid.solenoidal(white_modes(self.grid, frame, sample, weights))
        return found + self.grid.at(self._amplitude * modes, points)


def positive_solution(matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """Solve two equations for two numbers that are not negative. If there is no such solution, return the numbers with
    the smallest sum of squared relative residuals; zeros if `right` is not positive."""
    if not (right > 0).all():
        return np.zeros(2)
    scaled = matrix / right[:, None]
    found = np.linalg.solve(scaled, np.ones(2))
    if (found >= 0).all():
        return found
    alone = [np.eye(2)[i] * scaled[:, i].sum() / (scaled[:, i] @ scaled[:, i]) for i in range(2)]
    return min(alone, key=lambda numbers: float(np.square(scaled @ numbers - 1).sum()))


def carried_weights(angle: float) -> np.ndarray:
    """Return `weights` of frames whose autocorrelation is exp(-(angle lag)^2 / 2): that of a mode with a normally
    distributed velocity, whose rms turns its phase by `angle` from frame to frame."""
    lags = np.arange(min(math.ceil(CARRIED / angle), MOST_CARRIED) + 1 if angle > 0 else 1)
    weights = np.exp(-(angle * np.append(lags[:0:-1], lags)) ** 2)
    return weights / np.linalg.norm(weights)


def white_modes(grid: FourierGrid, frame: int, sample: int, weights: Sequence[float] = ALONE) -> Tensor:
    """Return modes (3, kz, ky, kx) of random fields; the mean square of each component of a mode is 1.

    A field is the sum of independent ones of this and later frames with these weights, whose squares have the sum 1.
    Each plane of the grid has its own generator, so the fields do not depend on the number of ranks. Collective.
    """
    slab = grid.decomposition
    planes = [sum(weight * np.random.default_rng([frame + later, sample, plane]).standard_normal(
        (3, slab.planes, slab.planes)) for later, weight in enumerate(weights))
        for plane in range(slab.start, slab.stop)]
    fields = np.stack(planes, axis=1) if planes else np.zeros((3, 0, slab.planes, slab.planes))
    return grid.to_modes(torch.from_numpy(fields).to(grid.dtype)) * slab.planes**1.5


def normal(ids: np.ndarray, frame: int, sample: int, weights: Sequence[float] = ALONE) -> Tensor:
    """Return random numbers (n, 3) with a standard normal distribution that depend on the ids (n,), the frame and the
    sample only (Box and Muller). `weights` are as in `white_modes`."""
    total, own = np.zeros((len(ids), 3)), mixed(ids)[:, None] ^ mixed(np.arange(1, 4))
    for later, weight in enumerate(weights):
        key = mixed(np.array([(frame + later) * 2**32 + sample]))
        first, second = ((mixed(own ^ (key + np.uint64(number))) >> np.uint64(11)) + 0.5 for number in range(2))
        total += weight * np.sqrt(-2 * np.log(first / 2.0**53)) * np.cos(2 * math.pi * second / 2.0**53)
    return torch.from_numpy(total)


def mixed(ids: np.ndarray) -> np.ndarray:
    """Return 64 bits for each integer, which look random."""
    bits = ids.astype(np.uint64)
    for shift, factor in MIXING:
        bits = (bits ^ bits >> np.uint64(shift)) * np.uint64(factor)
    return bits


def _square(values: Tensor) -> float:
    return float(values.square().sum())
