"""The velocity that particles resolve: solenoidal modes found from theirs by regularised least squares."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.flow_units import FlowUnits, resolved_wavenumber
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.least_squares import LeastSquares, Solution
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.resolved_flow import ResolvedFlow
from eddies.spectral.mode_operators import gaussian_transfer

# The exponent of the prior's power law, how it ends in the dissipation range (Pope 2000, Eq. 6.248), and how many
# times the energy that it expects beyond the resolved modes is taken for noise. The latter measured in docs/closure.md.
EXPONENT, DISSIPATION, DISSIPATION_ONSET, WEIGHT = 11 / 3, 5.2, 0.4, 100.0
# Residuals, relative to the velocities, at which a solve ends: one that starts from nothing, and one that starts from
# what is foreseen. The latter's is spread over all modes, the former's is left in those that are hardest to tell. At
# twice the latter a forced flow ran away (docs/closure.md).
TOLERANCE, TOLERANCE_FORESEEN = 2e-4, 1e-3
# The same of the solve on the way back, relative to the gradient that it is given: makes gradients of a loss through
# four frames wrong by 2e-3, in half of the iterations of 2e-4.
TOLERANCE_ADJOINT = 3e-3
MOST_ITERATIONS = 300
# Wavenumber shells in a band of the energy.
BAND = 2


class ResolvedVelocity:
    """Makes a `ResolvedFlow` of particles: the solenoidal modes u(k), 0 < |k| <= k_c, that

        minimise  sum_i |v_i - u(x_i)|^2  +  sum_k (sigma^2 / P_k) |u(k)|^2

    as is done for measured particle tracks (Gesemann et al. 2016). The velocities v_i are relative to their mean over
    all particles. P_k ~ k^(-11/3) f(k eta) G^2, f the end of the spectrum in the dissipation range and G the transfer
    of the filter, is the energy expected of a mode, and sigma^2 `weight` times what this law has beyond k_c, which is
    noise to the modes within; both in units of the velocities, so that their ratio is a number. As the filtered
    velocity is smooth and solenoidal, modes beyond the particles' Nyquist wavenumber can be told.

    Conjugate gradients, preconditioned by 1 / (N + 5 sigma^2/P_k), solve for the modes until the preconditioned
    residual is `tolerance` of the velocities; or take a given number of `iterations`. Where the time of an evaluation
    is given they start from what earlier ones foresee, see `foreseen`, and end at `tolerance_foreseen`; on the way back
    at `tolerance_adjoint`.

    Products of modes above a third of the number of cells alias; for fields known from particles that is far below the
    error of the highest modes themselves.

    Parameters
    ----------
    grid : where the velocity is resolved.
    filter_width : d of the filter.
    kolmogorov_length : eta of the flow; 0 where nothing ends its spectrum.
    weight : of what is expected beyond k_c, taken for noise.

    Differentiable in the particles' positions and velocities: on the way back the same system is solved. All ranks call
    it together. Raises HaloError, on all ranks, where a particle lies farther outside its slab than the grid reaches.
    """

    tolerance, tolerance_foreseen, tolerance_adjoint = TOLERANCE, TOLERANCE_FORESEEN, TOLERANCE_ADJOINT
    most_iterations = MOST_ITERATIONS
    iterations: int | None = None
    #: iterations and residual of the solves so far, and whether they converged, one after the other
    solves: list[tuple[int, float, bool]]
    #: modes that the last solve found; None before
    found: Tensor | None = None

    def __init__(self, grid: FourierGrid, filter_width: float, kolmogorov_length: float = 0.0,
                 weight: float = WEIGHT) -> None:
        self.grid, self.filter_width = grid, filter_width
        inside = (grid.shell > 0) & (grid.shell <= grid.resolved)
        self._moments: list[_Moment] = []
        self.solves = []
        #: rms u' of a component of the resolved velocity last remembered; 0 before
        self.speed = 0.0
        law, tail = _prior(grid, filter_width, kolmogorov_length, inside)
        penalty = torch.where(inside, weight * tail / (3 * torch.where(inside, law, 1.0)), 0.0)
        #: whose solution it is
        self.equations = LeastSquares(grid, inside, penalty)

    @classmethod
    def on_slabs(cls, decomposition: SlabDecomposition, flow: FlowUnits, margin: float = 0.0,
                 dtype: torch.dtype | None = None) -> ResolvedVelocity:
        """On a grid of one cell for each plane of the slabs, for particles that lie at most `margin` outside them; in
        double precision unless `dtype` is another."""
        scales = flow.scales
        highest = resolved_wavenumber(scales.spacing, scales.filter_width, scales.kolmogorov_length)
        shells = int(highest * decomposition.length / (2 * math.pi) + 1e-9)
        resolved = min(max(shells, 1), (decomposition.planes - 1) // 2)
        planes = max(math.ceil(margin / decomposition.spacing - 1e-9), 1)
        grid = FourierGrid(decomposition, resolved, planes, dtype or torch.float64)
        return cls(grid, scales.filter_width, scales.kolmogorov_length)

    def of(self, particles: ParticleSet, time: float | None = None, near: Tensor | None = None) -> ResolvedFlow:
        """The resolved flow of particles; `time` tells what is foreseen of it. `near`: modes (3, kz, ky, kx) that are
        known to be near it, without a time."""
        self._require_reach(particles.position)
        comm = self.grid.decomposition.comm
        mean = mean_over_ranks(comm, particles.velocity)
        relative, points = particles.velocity - mean, self.grid.points(particles.position)
        flow = ResolvedFlow(self.grid, self.grid.zeros(3), points, relative, self.filter_width)
        with torch.no_grad():
            count, square = global_sum(comm, np.array([len(relative), float(relative.double().square().sum())]))
            speed = math.sqrt(square / (3 * count)) if count else 0.0
            start = None if near is None else self.equations.projected(near)
            if time is not None:
                start = self.foreseen(time, as_numpy(mean), speed)
            flow = self._solved(flow, start, count, square)
        self.solves.append((flow.iterations, flow.residual, flow.converged))
        self.found = flow.velocity.detach()
        if torch.is_grad_enabled():
            flow = replace(flow, left_over=None)  # which is without a gradient
            gradient = self._descent(flow, flow.missing())
            flow = replace(flow, velocity=_Solution.apply(gradient, flow.velocity, self._adjoint(flow)))
        return flow

    def band_energies(self, particles: ParticleSet, near: Tensor | None = None) -> Tensor:
        """Mean kinetic energy <u.u>/2 of the resolved velocity by bands of `BAND` wavenumber shells, from shell 1 on:
        (bands,), over all ranks; collective, differentiable. `near` as for `of`."""
        spectrum = self.of(particles, near=near).spectrum[1:]
        return torch.nn.functional.pad(spectrum, (0, -len(spectrum) % BAND)).view(-1, BAND).sum(1)

    # ---- from one evaluation to the next

    @torch.no_grad()
    def remember(self, time: float, flow: ResolvedFlow, force: Tensor | None) -> None:
        """Keep a flow and its rate of change for later evaluations to start from. `force` are the modes
        (3, kz, ky, kx) of the particles' acceleration as a field: du/dt = P[force - div(uu)], P the solenoidal
        projection, in the frame that moves with the particles' mean velocity."""
        rate = self.equations.projected((0 if force is None else force.detach()) - flow.convection)
        self._moments = [moment for moment in self._moments if moment.time != time][-1:]
        self._moments.append(_Moment(time, flow.velocity.detach(), rate))
        self.speed = float(flow.rms)

    def foreseen(self, time: float, mean: np.ndarray, speed: float) -> Tensor | None:
        """The modes at a time, extrapolated from the nearer of the last two evaluations at different times by the rates
        of both (Adams and Bashforth), carried along by the mean velocity (3,) of the particles; None where nothing is
        known.

        Each is as large as it deserves. A flow of rms `speed` u' a component turns the phase of a mode by
        theta = k u' dt in a time dt, and the forecast misses (5/12) theta^3 of it: 1.6 times the rms, where velocities
        are normal. Modes that two or three u' would spoil count as unknown, 1 / (1 + (2 theta)^6), because one that is
        wrong is worse than one that is missing: it is put right only where there are particles, and goes on growing
        elsewhere.
        """
        if not self._moments:
            return None
        near, *others = sorted(reversed(self._moments), key=lambda moment: abs(time - moment.time))
        step, rate = time - near.time, near.rate
        for other in others:
            between = near.time - other.time
            rate = rate + step / (2 * between) * (rate - self._carried(other.rate, between, mean))
        worth = 1 / (1 + (2 * self.grid.wavenumber_squared.sqrt() * speed * step) ** 6)
        return worth * self._carried(near.velocity + step * rate, step, mean)

    def forget(self) -> None:
        """Start the next solve from nothing."""
        self._moments, self.solves, self.speed, self.found = [], [], 0.0, None

    def state_dict(self) -> dict[str, Tensor]:
        """What later solves start from: times (m,), and modes (m, 2, 3, kz, ky_local, kx) of velocity and rate; and the
        speed."""
        modes = [torch.stack([moment.velocity, moment.rate]) for moment in self._moments]
        return {"times": torch.tensor([moment.time for moment in self._moments], dtype=torch.float64),
                "modes": torch.stack(modes) if modes else self.grid.zeros(0, 2, 3),
                "speed": torch.tensor(self.speed, dtype=torch.float64)}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`."""
        modes = state["modes"].to(self.grid.dtype.to_complex())
        self._moments = [_Moment(float(time), *pair) for time, pair in zip(state["times"], modes)]
        self.speed = float(state["speed"])

    def _carried(self, modes: Tensor, step: float, mean: np.ndarray) -> Tensor:
        """Modes of a field that has moved with the mean velocity for a time."""
        turns = [torch.exp(-1j * step * velocity * k) for k, velocity in zip(self.grid.wavevector, mean)]
        return math.prod(turns) * modes

    # ---- the solve

    def _solved(self, flow: ResolvedFlow, start: Tensor | None, count: float, square: float) -> ResolvedFlow:
        """The flow with the modes that conjugate gradients find, of `count` particles with sum_i |v_i|^2 = `square`."""
        if start is not None:
            flow = replace(flow, velocity=start)
        missing = flow.missing()
        right = self._descent(flow, missing)
        begin = self.equations.size(right, count)
        tolerance = self.tolerance if start is None else self.tolerance_foreseen
        if begin > square and start is not None:  # worse than nothing is
            return self._solved(replace(flow, velocity=torch.zeros_like(start)), None, count, square)
        change = self._change(flow, right, count, tolerance**2 * square)
        # What is not finite has not converged.
        return replace(flow, velocity=flow.velocity + change.modes, iterations=change.iterations,
                       left_over=missing - change.at_points.to(missing),
                       residual=math.sqrt(change.left / square) if square > 0 else 0.0,
                       converged=self.iterations is not None or change.left <= tolerance**2 * square)

    def _change(self, flow: ResolvedFlow, right: Tensor, count: float, enough: float) -> Solution:
        return self.equations.solve(flow.points, right, count, enough, self.iterations, self.most_iterations)

    def _descent(self, flow: ResolvedFlow, missing: Tensor) -> Tensor:
        """Half the steepest descent of what is minimised, P B^T (v - B u) - (sigma^2/P_k) u, zero at its minimum, with
        `missing` = v - B u."""
        return self.equations.descent(missing, flow.points, flow.velocity)

    def _adjoint(self, flow: ResolvedFlow) -> Callable[[Tensor], Tensor]:
        """By the implicit function theorem: the gradient by modes of the minimum -> that by the descent there.

        The descent d(u; x, v) is zero at the minimum and changes with u by -A, so that du = A^-1 dd. A is symmetric in
        the inner product in which modes count by their multiplicity m, therefore its transpose is m A (1/m).
        """
        grid, count = self.grid, float(global_sum(self.grid.decomposition.comm, len(flow.relative_velocity)))

        def solve(gradient: Tensor) -> Tensor:
            # The part that belongs to a real field; what else there is has no effect on any value.
            fields = grid.to_fields(gradient.resolve_conj() / grid.multiplicity)
            right = self.equations.projected(grid.to_modes(fields))
            enough = self.tolerance_adjoint**2 * self.equations.size(right, count)
            found = self._change(flow, right, count, enough)
            residual = self.tolerance_adjoint * math.sqrt(found.left / enough) if enough > 0 else 0.0
            self.solves.append((found.iterations, residual,
                                self.iterations is not None or found.left <= enough))
            return grid.multiplicity * found.modes

        return solve

    def _require_reach(self, position: Tensor) -> None:
        slab, reach, position = self.grid.decomposition, self.grid.reach, position.detach()
        z, lost = position[:, 2], not bool(torch.isfinite(position).all())
        outside = slab.size > 1 and bool(((z < slab.lower - reach) | (z >= slab.upper + reach)).any())
        if (worst := global_max(slab.comm, 2.0 * lost or 1.0 * outside)) == 2:
            raise HaloError("the position of a particle is not finite: shorten the time step")
        if worst == 1:
            raise HaloError(f"a particle moves more than {reach:.3g} out of its slab before it can change rank, and "
                            "the ghost planes reach no farther: shorten the time step or the skin")


@dataclass(frozen=True)
class _Moment:
    """Modes of the resolved velocity at a time, and of its rate of change."""

    time: float
    velocity: Tensor
    rate: Tensor = field(repr=False)


class _Solution(torch.autograd.Function):
    """The modes that make the descent zero, as a function of the descent at these very modes."""

    @staticmethod
    def forward(ctx, descent: Tensor, modes: Tensor, adjoint: Callable[[Tensor], Tensor]) -> Tensor:
        ctx.adjoint = adjoint
        return modes.clone()

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None, None]:
        return ctx.adjoint(gradient), None, None


def dissipation_range(wavenumber: np.ndarray) -> np.ndarray:
    """f(k eta), by which spectra fall below the power law of the inertial range: exp(-5.2 ((k eta)^4 + 0.4^4)^(1/4) +
    5.2 * 0.4) (Pope 2000, Eq. 6.248); 1 where `wavenumber`, k eta, is 0."""
    return np.exp(DISSIPATION * (DISSIPATION_ONSET - (wavenumber**4 + DISSIPATION_ONSET**4) ** 0.25))


def _prior(grid: FourierGrid, filter_width: float, kolmogorov_length: float,
           inside: Tensor) -> tuple[Tensor, float]:
    """Energy P_k of a component of each mode (kz, ky, kx), and the energy beyond, for <v.v> = 1."""
    unit = 2 * math.pi / grid.decomposition.length

    def law(shell):
        k = unit * shell
        return shell**-EXPONENT * dissipation_range(k * kolmogorov_length) * gaussian_transfer(k**2, filter_width) ** 2

    modes = torch.where(inside, torch.from_numpy(law(grid.shell.clamp_min(1).numpy())), 0.0)
    total = float(global_sum(grid.decomposition.comm, float(2 * (modes * grid.multiplicity).sum())))
    shells = np.arange(1, 40 * grid.resolved, dtype=float)
    energy = shells**2 * law(shells)
    return modes / total, float(energy[shells > grid.resolved].sum() / energy.sum())
