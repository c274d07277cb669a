"""The velocity that particles resolve: solenoidal modes from their velocities by regularised least squares."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import mean_over_ranks, sum_over_ranks
from eddies.particles.flow_units import ReferenceScales, resolved_shells
from eddies.particles.fourier_grid import FourierGrid, Points
from eddies.particles.least_squares import LeastSquares, Solution
from eddies.particles.neighborhood import at_home, farthest_outside
from eddies.particles.particle_set import ParticleSet
from eddies.spectral.interpolation import margin_for
from eddies.spectral.mode_operators import gaussian_transfer

# Exponent of the prior's power law, the two constants of its dissipation range (Pope 2000, Eq. 6.248), and the ratio of
# the noise to the expected unresolved energy. The ratio is measured in docs/methods.md.
EXPONENT, DISSIPATION, DISSIPATION_ONSET, WEIGHT = 11 / 3, 5.2, 0.4, 100.0
# Final residuals relative to the velocities, of a solve that starts from zero and of one that starts from a prediction.
# A solve from zero leaves its residual in poorly determined modes; a solve from a prediction leaves it in all modes. At
# twice the second value a forced flow diverged (docs/methods.md).
TOLERANCE, TOLERANCE_PREDICTED = 2e-4, 1e-3
# Final residual of the solve in the backward pass, relative to the incoming gradient. Gradients of a loss through four
# frames then have an error of 2e-3, and the solve takes half as many iterations as with a tolerance of 2e-4.
TOLERANCE_ADJOINT = 3e-3
MOST_ITERATIONS = 300
# k eta beyond which the prior's spectrum has no dissipation: less than 1e-8 of it.
SPECTRUM_END = 4.0
# Number of wavenumber shells in each band of `band_energies`.
BAND = 2


@dataclass(frozen=True)
class ResolvedFlow:
    """The resolved velocity at one moment.

    Parameters
    ----------
    grid : grid of the modes.
    mean : (3,), the mean of the resolved velocity over the box, its zeroth mode.
    velocity : modes (3, kz, ky, kx) of the resolved velocity minus `mean`, solenoidal, 0 < |k| <= `grid.resolved`.
    points : the owned particles on the grid.
    relative_velocity : (n, 3), velocity of the particles minus `mean`.
    filter_width : d of the filter that the particles' velocity has passed.
    left_over : (n, 3), the result of `missing` if it is known, else None.
    iterations, residual : number of iterations of the solve, and its final residual relative to the velocities.
    converged : whether the residual reached its tolerance.
    """

    grid: FourierGrid
    mean: Tensor
    velocity: Tensor
    points: Points
    relative_velocity: Tensor
    filter_width: float
    left_over: Tensor | None = None
    iterations: int = 0
    residual: float = 0.0
    converged: bool = True

    def at_particles(self, modes: Tensor) -> Tensor:
        """Values (n, c) of modes (c, kz, ky, kx) at the particles; collective, differentiable."""
        return self.grid.at(modes, self.points)

    def missing(self) -> Tensor:
        """Unresolved velocity (n, 3): `relative_velocity` minus the resolved velocity at the particles; collective."""
        if self.left_over is not None:
            return self.left_over
        return self.relative_velocity - self.at_particles(self.velocity).to(self.relative_velocity)

    @property
    def modes(self) -> Tensor:
        """Modes (3, kz, ky, kx) of the resolved velocity, with its mean as the zeroth mode."""
        return self.grid.with_mean(self.velocity, self.mean)

    @cached_property
    def spectrum(self) -> Tensor:
        """E(k) (k_c + 1,), the energy of the modes whose |k| rounds to k = 0, 1, ..., k_c, over all ranks.

        |k| is in units of the smallest wavenumber. The last shell holds only modes up to k_c. The sum of E is <u.u>/2
        of the resolved velocity u minus its mean. Collective, differentiable.
        """
        grid = self.grid
        energy = 0.5 * grid.multiplicity * (self.velocity.real.square() + self.velocity.imag.square()).sum(0)
        shell = torch.round(grid.shell).long()
        inside = shell <= grid.resolved
        spectrum = energy.new_zeros(grid.resolved + 1, dtype=torch.float64)
        return sum_over_ranks(grid.decomposition.comm, spectrum.index_add(0, shell[inside], energy[inside].double()))

    @cached_property
    def products(self) -> Tensor:
        """Modes (6, kz, ky, kx) of u_i u_j; collective, differentiable."""
        return self.grid.squares(self.velocity)

    @cached_property
    def convection(self) -> Tensor:
        """Modes (3, kz, ky, kx) of d_j (u_i u_j); collective, differentiable."""
        return self.grid.stress_divergence(self.products)

    @property
    def filter_transfer(self) -> Tensor:
        return self.grid.filter_transfer(self.filter_width)

    @cached_property
    def unfiltered(self) -> Tensor:
        """Modes (3, kz, ky, kx) of u* = u / G."""
        return self.velocity * (1 / self.filter_transfer)  # a complex division is ten times slower

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square of a component of the resolved velocity; collective, differentiable."""
        return self._rms_of(self.velocity, 0)

    @cached_property
    def smallest_rms(self) -> Tensor:
        """Root mean square of a velocity component of the modes of u* with |k| > k_c/2; collective, differentiable."""
        return self._rms_of(self.unfiltered, self.grid.resolved / 2)

    def _rms_of(self, modes: Tensor, above: float) -> Tensor:
        # The lower bound makes the derivative of the root zero for a fluid at rest.
        return (self.grid.mean_square(modes, above) / 3).clamp_min(torch.finfo(torch.float64).tiny).sqrt()


class ResolvedVelocity:
    """Computes the `ResolvedFlow` of particles: the solenoidal modes u(k), |k| <= k_c, that

        minimise  sum_i |v_i - u(x_i)|^2  +  sum_k (sigma^2 / P_k) |u(k)|^2

    as for measured particle tracks (Gesemann et al. 2016). The zeroth mode, the mean of u over the box, has no penalty.
    It is not the mean over the particles, because particles do not sample the box evenly. P_k ~ k^(-11/3) f(k eta) G^2
    is the expected energy of a component of a mode. f describes the dissipation range of the spectrum, and G is the
    transfer function of the filter. sigma^2 is `weight` times the energy of a velocity component that this law predicts
    beyond k_c; this energy acts as noise on the modes up to k_c. Since the filtered velocity is smooth and solenoidal,
    modes beyond the particles' Nyquist wavenumber are determined too.

    The solve uses conjugate gradients, preconditioned by 1 / (N + 5 sigma^2/P_k). It ends when the norm of the
    preconditioned residual is `tolerance` times that of the velocities, or after a given number of `iterations`. A
    solve that starts from a prediction (`predicted`) or from given modes has the tolerance `tolerance_predicted`. The
    solve in a backward pass has the tolerance `tolerance_adjoint`.

    Products of modes above a third of the number of cells are aliased. For fields known at particles the aliasing error
    is far below the error of the highest modes themselves.

    Parameters
    ----------
    grid : grid of the modes.
    filter_width : d of the filter.
    kolmogorov_length : eta of the flow; 0 if its spectrum has no dissipation range.
    weight : factor of the noise sigma^2.
    periods : numbers of periods of the flow in the box along x, y and z. Particles in one of them determine the flow.

    Differentiable in the particles' positions and velocities: the backward pass solves the same system. All methods are
    collective. Raises HaloError on all ranks if a particle is farther outside its slab than the ghost planes reach.
    """

    tolerance, tolerance_predicted, tolerance_adjoint = TOLERANCE, TOLERANCE_PREDICTED, TOLERANCE_ADJOINT
    most_iterations = MOST_ITERATIONS
    iterations: int | None = None
    #: number of iterations, residual, and whether it converged, of each solve so far
    solves: list[tuple[int, float, bool]]
    #: modes of the last solve; None before the first
    latest: Tensor | None = None

    def __init__(self, grid: FourierGrid, filter_width: float, kolmogorov_length: float = 0.0,
                 weight: float = WEIGHT, periods: Sequence[int] = (1, 1, 1)) -> None:
        self.grid, self.filter_width, self.periods = grid, filter_width, periods
        #: `expected_energy` of the flow
        self.expected_energy = partial(expected_energy, filter_width=filter_width, kolmogorov_length=kolmogorov_length)
        inside = (grid.shell <= grid.resolved) & grid.repeating(periods)
        penalized = (grid.shell > 0) & inside
        #: expected energy beyond k_c, in units of <v.v>
        energy, self.unresolved = self.expected_energy(grid, penalized)
        penalty = torch.where(penalized, weight * self.unresolved / (3 * torch.where(penalized, energy, 1.0)), 0.0)
        self.equations = LeastSquares(grid, inside, penalty)
        self.forget()

    @classmethod
    def on_slabs(cls, decomposition: SlabDecomposition, scales: ReferenceScales, margin: float = 0.0,
                 dtype: torch.dtype | None = None, weight: float = WEIGHT,
                 periods: Sequence[int] = (1, 1, 1)) -> ResolvedVelocity:
        """Make an instance whose grid has as many cells along each axis as all slabs together have planes.

        Particles may be outside their slab by `margin` at most. The default precision is double.
        """
        resolved = resolved_shells(scales.spacing, scales.filter_width, scales.kolmogorov_length, decomposition.length,
                                   decomposition.planes)
        margin_planes = margin_for(margin, decomposition.spacing)
        grid = FourierGrid(decomposition, resolved, margin_planes, dtype or torch.float64)
        return cls(grid, scales.filter_width, scales.kolmogorov_length, weight, periods)

    def of(self, particles: ParticleSet, time: float | None = None, near: Tensor | None = None) -> ResolvedFlow:
        """Compute the resolved flow of particles.

        The solve starts from the prediction for `time` if this is given, else from the modes `near` (3, kz, ky, kx) of
        a velocity, or from zero without either. Velocities in the solve are relative to the mean over the particles;
        this choice has no effect on the minimum.
        """
        reach = self.grid.reach
        if farthest_outside(self.grid.decomposition, particles) >= reach:
            raise HaloError(f"a particle is more than {reach:.3g} outside the slab of its rank, where the "
                            "ghost planes end; shorten the time step or the skin")
        comm = self.grid.decomposition.comm
        frame = mean_over_ranks(comm, particles.velocity.detach())
        relative, points = particles.velocity - frame, self.grid.points(particles.position)
        flow = ResolvedFlow(self.grid, frame, self.grid.zeros(3), points, relative, self.filter_width)
        with torch.no_grad():
            count, square = global_sum(comm, np.array([len(relative), float(relative.double().square().sum())]))
            speed = math.sqrt(square / (3 * count)) if count else 0.0
            start = self.predicted(time, speed) if time is not None else near
            if start is not None:
                start = self.equations.projected(self.grid.with_mean(start, -frame))
            flow = self._solved(flow, start, count, square)
        self.solves.append((flow.iterations, flow.residual, flow.converged))
        if torch.is_grad_enabled():
            flow = replace(flow, left_over=None)  # it has no gradient
            descent = self.equations.descent(flow.missing(), flow.points, flow.velocity)
            flow = replace(flow, velocity=_Solution.apply(descent, flow.velocity, self._adjoint(flow)))
        drift = self.grid.mean(flow.velocity)
        flow = replace(flow, mean=frame + drift, velocity=self.grid.without_mean(flow.velocity),
                       relative_velocity=relative - drift.to(relative))
        self.latest = flow.modes.detach()
        return flow

    def band_energies(self, particles: ParticleSet, near: Tensor | None = None) -> Tensor:
        """Return the kinetic energy <u.u>/2 of each band of `BAND` wavenumber shells from shell 1 on: (bands,).

        The particles may be on any rank. `near` is as in `of`. Collective, differentiable.
        """
        slab = self.grid.decomposition
        moved = ParticleSet(**at_home(slab, particles.columns(), slab.spacing))
        spectrum = self.of(moved, near=near).spectrum[1:]
        return torch.nn.functional.pad(spectrum, (0, -len(spectrum) % BAND)).view(-1, BAND).sum(1)

    # ---- predictions for the next evaluation

    @torch.no_grad()
    def remember(self, time: float, flow: ResolvedFlow, force: Tensor | None) -> None:
        """Store a flow and its rate of change for later predictions.

        `force` are the modes (3, kz, ky, kx) of the particles' acceleration; None: no acceleration. The rate is
        du/dt = P[force - div(uu)], P the solenoidal projection, in the frame that moves with the particles' mean
        velocity.
        """
        rate = self.equations.projected((0 if force is None else force.detach()) - flow.convection)
        self._moments = [moment for moment in self._moments if moment.time != time][-1:]
        self._moments.append(_Moment(time, flow.mean.detach(), flow.velocity.detach(), rate))
        self.speed = float(flow.rms)

    def predicted(self, time: float, speed: float) -> Tensor | None:
        """Predict the modes at a time; None without earlier evaluations.

        The nearer of the last two evaluations at different times is extrapolated with the rates of both (Adams and
        Bashforth). The field moves with the mean velocity of this evaluation, which does not change. Each mode is
        multiplied by a factor that decreases with its expected error. A velocity u' = `speed`, the rms of a component,
        turns the phase of a mode by theta = k u' dt in a time dt. The relative error of the prediction is then (5/12)
        theta^3; its rms over normally distributed velocities is 1.6 theta^3. The factor 1 / (1 + (2 theta)^6) removes
        modes that velocities of two or three u' would spoil. A wrong mode is worse than a missing one: the solve
        corrects it only near particles, and it grows elsewhere.
        """
        if not self._moments:
            return None
        near, *others = sorted(reversed(self._moments), key=lambda moment: abs(time - moment.time))
        step, rate = time - near.time, near.rate
        for other in others:
            between = near.time - other.time
            rate = rate + step / (2 * between) * (rate - self.advected(other.rate, between, near.mean))
        worth = 1 / (1 + (2 * self.grid.wavenumber_squared.sqrt() * speed * step) ** 6)
        return self.grid.with_mean(worth * self.advected(near.velocity + step * rate, step, near.mean), near.mean)

    def forget(self) -> None:
        """Discard predictions: the next solve starts from zero."""
        self._moments: list[_Moment] = []
        self.solves, self.latest = [], None
        #: rms u' of a component of the resolved velocity that was stored last; 0 if none was
        self.speed = 0.0

    def state_dict(self) -> dict[str, Tensor]:
        """State for later solves: `times` (m,) of the stored moments, at these times the `means` (m, 3) of the velocity
        and the `modes` (m, 2, 3, kz, ky_local, kx) of velocity and rate, and `speed`."""
        means = [moment.mean for moment in self._moments]
        modes = [torch.stack([moment.velocity, moment.rate]) for moment in self._moments]
        return {"times": torch.tensor([moment.time for moment in self._moments], dtype=torch.float64),
                "means": torch.stack(means) if means else torch.zeros(0, 3, dtype=torch.float64),
                "modes": torch.stack(modes) if modes else self.grid.zeros(0, 2, 3),
                "speed": torch.tensor(self.speed, dtype=torch.float64)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        modes = state["modes"].to(self.grid.dtype.to_complex())
        self._moments = [_Moment(float(time), mean, *pair)
                         for time, mean, pair in zip(state["times"], state["means"], modes)]
        self.speed = float(state["speed"])

    def advected(self, modes: Tensor, step: float, mean: Tensor) -> Tensor:
        """Return the modes of a field after it has moved with the `mean` velocity (3,) for the time `step`."""
        turns = [torch.exp(-1j * step * velocity * k) for k, velocity in zip(self.grid.wavevector, mean.tolist())]
        return math.prod(turns) * modes

    # ---- the solve

    def _solved(self, flow: ResolvedFlow, start: Tensor | None, count: float, square: float) -> ResolvedFlow:
        """Return the flow with its modes, found from `start`, for `count` particles with sum_i |v_i|^2 = `square`."""
        if start is not None:
            flow = replace(flow, velocity=start)
        missing = flow.missing()
        right = self.equations.descent(missing, flow.points, flow.velocity)
        begin = self.equations.size(right, count)
        tolerance = self.tolerance if start is None else self.tolerance_predicted
        if begin > square and start is not None:  # the prediction is worse than zero
            return self._solved(replace(flow, velocity=torch.zeros_like(start)), None, count, square)
        change = self._change(flow, right, count, tolerance**2 * square)
        return replace(flow, velocity=flow.velocity + change.modes, iterations=change.iterations,
                       left_over=missing - change.at_points.to(missing),
                       residual=math.sqrt(change.left / square) if square > 0 else 0.0,
                       # false for NaN
                       converged=self.iterations is not None or change.left <= tolerance**2 * square)

    def _change(self, flow: ResolvedFlow, right: Tensor, count: float, enough: float) -> Solution:
        return self.equations.solve(flow.points, right, count, enough, self.iterations, self.most_iterations)

    def _adjoint(self, flow: ResolvedFlow) -> Callable[[Tensor], Tensor]:
        """Return a function that turns the gradient of a loss with respect to the modes u at the minimum into the
        gradient with respect to the descent d(u; x, v) there.

        d vanishes at the minimum, and its derivative with respect to u is -A. So a change dd of the descent moves the
        minimum by du = A^-1 dd (implicit function theorem). A is symmetric in the inner product that weights modes by
        their multiplicity m. Its transpose is therefore m A (1/m).
        """
        grid, count = self.grid, float(global_sum(self.grid.decomposition.comm, len(flow.relative_velocity)))

        def solve(gradient: Tensor) -> Tensor:
            # Only the part that belongs to a real field affects any value.
            fields = grid.to_fields(gradient.resolve_conj() / grid.multiplicity)
            right = self.equations.projected(grid.to_modes(fields))
            enough = self.tolerance_adjoint**2 * self.equations.size(right, count)
            change = self._change(flow, right, count, enough)
            residual = self.tolerance_adjoint * math.sqrt(change.left / enough) if enough > 0 else 0.0
            self.solves.append((change.iterations, residual,
                                self.iterations is not None or change.left <= enough))
            return grid.multiplicity * change.modes

        return solve


class _Moment(NamedTuple):
    """Mean and other modes of the resolved velocity, and its rate of change, at one time."""

    time: float
    mean: Tensor
    velocity: Tensor
    rate: Tensor


class _Solution(torch.autograd.Function):
    """The modes at which the descent vanishes, as a function of the descent at these modes."""

    @staticmethod
    def forward(ctx, descent: Tensor, modes: Tensor, adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.adjoint = adjoint
        return modes.clone()

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.adjoint(gradient), None, None


def dissipation_range(k_eta: np.ndarray) -> np.ndarray:
    """Return exp(-5.2 ((k eta)^4 + 0.4^4)^(1/4) + 5.2 * 0.4), the factor of spectra in the dissipation range (Pope
    2000, Eq. 6.248)."""
    return np.exp(DISSIPATION * (DISSIPATION_ONSET - (k_eta**4 + DISSIPATION_ONSET**4) ** 0.25))


def expected_energy(grid: FourierGrid, inside: Tensor, filter_width: float,
                    kolmogorov_length: float) -> tuple[Tensor, float]:
    """Return the energy P_k (kz, ky, kx) of each of the two solenoidal components of a mode, and the energy beyond the
    highest wavenumber of the grid.

    P_k is in units of <v.v> of the modes `inside`, and 0 for others. The energy beyond is in units of <v.v> of all
    modes.
    """
    unit = 2 * math.pi / grid.decomposition.length
    law = partial(_mode_energy, filter_width=filter_width, kolmogorov_length=kolmogorov_length)
    modes = torch.where(inside, torch.from_numpy(law(unit * grid.shell.clamp_min(1).numpy())), 0.0)
    total = float(global_sum(grid.decomposition.comm, float(2 * (modes * grid.multiplicity).sum())))
    shells = np.arange(1, 40 * grid.resolved, dtype=float)
    energy = shells**2 * law(unit * shells)
    return modes / total, float(energy[shells > grid.resolved].sum() / energy.sum())


def _mode_energy(k: np.ndarray, filter_width: float, kolmogorov_length: float) -> np.ndarray:
    """Return k^(-11/3) f(k eta) G^2, the energy of a mode that the prior expects, up to a factor."""
    return k**-EXPONENT * dissipation_range(k * kolmogorov_length) * gaussian_transfer(k**2, filter_width) ** 2


def captured_dissipation(grid: FourierGrid, filter_width: float, kolmogorov_length: float) -> float:
    """Return the share of the dissipation rate of the unfiltered flow that modes up to k_c of the filtered one contain.

    It is that of the prior's spectrum: the sum of k^4 k^(-11/3) f(k eta) G^2 over |k| <= k_c, divided by the same sum
    with G = 1 over all k. Raises ValueError if `kolmogorov_length` is not positive: without a dissipation range the
    second sum is infinite.
    """
    if kolmogorov_length <= 0:
        raise ValueError(f"kolmogorov_length = {kolmogorov_length}: must be positive")
    unit = 2 * math.pi / grid.decomposition.length
    k = unit * np.arange(1, max(grid.resolved, math.ceil(SPECTRUM_END / (unit * kolmogorov_length))) + 1)
    filtered, whole = (k**4 * _mode_energy(k, width, kolmogorov_length) for width in (filter_width, 0.0))
    return float(filtered[:grid.resolved].sum() / whole.sum())
