"""The time step of a flow, its theoretical limits, and a check that ends an unstable run and names exceeded limits."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from eddies.clock import Clock, ladder_step
from eddies.errors import UserError
from eddies.flow.navier_stokes import Fluid, advective_speed
from eddies.parallel.reduction import global_max, global_sum
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import RungeKutta4

# Largest |z| on the imaginary and on the negative real axis in the stability region of the classical fourth-order
# Runge-Kutta method, |1 + z + z^2/2 + z^3/6 + z^4/24| <= 1.
IMAGINARY_REACH, REAL_REACH = math.sqrt(8), 2.785293563405282

# Above this advective number, undamped sound waves grow by more than 0.1 % per step of ETDRK4: see `limits_of_step`.
LEAK = 0.5

# A flow is unstable when its energy exceeds the available energy by this factor. The factor is generous: with strong
# density fluctuations the quadratic energy is several times the true one, or a fraction of it.
GROWTH = 10

EVERY = 8  # steps between two measurements of the speed

EXACT = ', or take stepper = "etdrk4", which has no such limit'
REMEDIES = {"advection": "lower courant or step", "sound": "lower courant or step" + EXACT,
            "viscosity": "lower max_step or step" + EXACT}


class FlowDiverged(UserError, RuntimeError):
    """The flow is not finite, or its energy grows far beyond the available energy."""

    def __init__(self, seen: str, clock: Clock, advice: str) -> None:
        super().__init__(f"unstable at step {clock.steps}, time {clock.time:.6g}: {seen}. {advice}")

    @classmethod
    def unless_finite(cls, number: float, clock: Clock) -> None:
        """Raise FlowDiverged if a number measured in a flow is not finite."""
        if not math.isfinite(number):
            raise cls("the flow is not finite", clock, "Correct the initial flow: amplitude or path"
                      if clock.steps == 0 else "Lower courant or step, or raise cells or viscosity")


class CourantLimit:
    """Time step with  step * (max(|u| + |v| + |w|) + sqrt(3) c) <= courant * dx.

    The step is the largest of largest * 2^-m, m = 0, 1, ..., within this limit. `sound_speed` is c for a stepper that
    treats sound explicitly, and 0 for others. The factor sqrt(3) belongs to sound that travels along the diagonal of a
    cell. The speed of the flow is measured every EVERY steps.
    """

    def __init__(self, grid: SpectralGrid, courant: float, largest: float, sound_speed: float = 0.0) -> None:
        self.grid, self.courant, self.largest, self.sound_speed = grid, courant, largest, sound_speed
        self._bound = 0.0

    def __call__(self, state: np.ndarray, clock: Clock) -> float:
        """Return the next step; the last step is shortened to end with the clock's span. Collective."""
        if clock.steps % EVERY == 0 or self._bound == 0.0:
            self._bound = self.bound(state, clock)
        return min(ladder_step(self.largest, self._bound), clock.remaining)

    def state_dict(self) -> dict[str, float]:
        return {"bound": self._bound}

    def load_state_dict(self, state: dict[str, float]) -> None:
        self._bound = state["bound"]

    def bound(self, state: np.ndarray, clock: Clock) -> float:
        """Return the longest step that the Courant number allows now. Raises FlowDiverged if the flow is not finite."""
        speed = float(global_max(self.grid.decomposition.comm, advective_speed(self.grid, state[:3])))
        FlowDiverged.unless_finite(speed, clock)
        speed += np.sqrt(3) * self.sound_speed
        return self.courant * self.grid.decomposition.spacing / speed if speed > 0 else np.inf


class FixedStep:
    """Constant time step; the last one is shortened to end with the clock's span."""

    def __init__(self, step: float) -> None:
        self.step = step

    def __call__(self, state: np.ndarray, clock: Clock) -> float:
        # A remaining time that differs from the step by round-off is a full step, because another step size would need
        # new operators f(step L).
        return self.step if clock.remaining > self.step * (1 - 1e-6) else clock.remaining

    def state_dict(self) -> dict[str, float]:
        """Return an empty state: the step comes from the scene."""
        return {}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Ignore the empty state."""

    def bound(self, state: np.ndarray, clock: Clock) -> float:
        return self.step


@dataclass(frozen=True)
class StepLimit:
    """A stability limit: the step is stable if `number`, which grows with the step, does not exceed `boundary`.

    `name` is a key of REMEDIES, and `expression` is the formula of the number as text.
    """

    name: str
    expression: str
    number: float
    boundary: float

    @property
    def exceeded(self) -> bool:
        return self.number > self.boundary

    def __str__(self) -> str:
        return f"{self.name}, {self.expression} = {self.number:.3g}, stable up to {self.boundary:.3g}"


def step_limits(fluid: Fluid, stepper: Callable, step: float, speed: float) -> list[StepLimit]:
    """Return the stability limits of a time step of a fluid; `speed` is the largest |u| + |v| + |w| in the flow."""
    grid = fluid.grid
    return limits_of_step(2 * math.pi / grid.decomposition.length * grid.cutoff, step, speed, fluid.viscosity,
                          isinstance(stepper, RungeKutta4), fluid.sound_speed if fluid.compressible else None)


def limits_of_step(k_max: float, step: float, speed: float, viscosity: float, explicit: bool,
                   sound_speed: float | None) -> list[StepLimit]:
    """Return the stability limits of a time step `step` of RK4 if `explicit`, else of ETDRK4.

    `speed` is the largest |u| + |v| + |w|, `k_max` the largest wavenumber along each axis, nu the viscosity and c the
    `sound_speed`, which is None without sound. The advective number is step k_max speed. The eigenvalues of the largest
    modulus belong to |k| = sqrt(3) k_max. They are i k_max (|u| + |v| + |w|) for advection, with i sqrt(3) k_max c
    added for sound. For viscosity they are -3 nu k_max^2, or -4 nu k_max^2 in a compressible fluid. The limits of RK4
    are where its stability region ends on the axes.

    ETDRK4 treats viscosity and sound exactly. Without them its stability region is that of RK4. Viscosity raises the
    largest stable advective number to 3.2, 3.9 and 4.9 at nu k^2 step = 1, 3 and 5, and to about 0.7 nu k^2 step at
    larger values. Undamped sound waves with c k step between 1 and 7 grow even below the advective limit. In a uniform
    flow they grow by up to 0.1, 2, 7 and 15 % per step at advective numbers of 0.5, 1, 1.5 and 2. A damping 2/3 nu k^2
    step of 0.0013, 0.024, 0.1 and 0.22 stops the growth at these numbers. In turbulence few points move at the largest
    speed: 60 steps at three times the limit did not raise the energy tenfold (12^3 cells, turbulent Mach numbers from
    0.01 to 0.5).
    """
    limits = [StepLimit("advection", "step x k_max x max(|u| + |v| + |w|)", step * k_max * speed, IMAGINARY_REACH)]
    if explicit:
        stretch = 3.0
        if sound_speed is not None:
            stretch = 4.0
            number = step * k_max * (speed + math.sqrt(3) * sound_speed)
            limits.append(StepLimit("sound", "step x k_max x (max(|u| + |v| + |w|) + sqrt(3) sound_speed)", number,
                                    IMAGINARY_REACH))
        limits.append(StepLimit("viscosity", f"step x {stretch:g} viscosity k_max^2",
                                step * stretch * viscosity * k_max**2, REAL_REACH))
    return limits


def advice(fluid: Fluid, limits: Sequence[StepLimit], kmax_eta: float, mach: float = 0.0) -> str:
    """Return text on the cause of an unstable run and its remedy.

    The cause is the exceeded limits, if there are any. Otherwise it is a turbulent Mach number `mach` above 1, or else
    a resolution `kmax_eta` that is too low.
    """
    broken = [limit for limit in limits if limit.exceeded]
    if broken:
        return "Exceeded limits: " + "; ".join(f"{limit}: {REMEDIES[limit.name]}" for limit in broken)
    if mach > 1:
        return (f"The flow is supersonic, its turbulent Mach number was {mach:.2g}, and shocks are not resolved: raise "
                "sound_speed, or lower amplitude or injection_rate")
    resolution = f"k_max eta was {kmax_eta:.2g}, about 1 is needed" if fluid.viscosity > 0 else "there is no viscosity"
    text = ("The step exceeded no limit (" + "; ".join(map(str, limits)) + f"), so the grid is probably too coarse "
            f"({resolution}): raise cells or viscosity")
    if fluid.compressible and len(limits) == 1 and limits[0].number > LEAK:
        text += ". Or weakly damped sound waves grow: lower courant or step"
    return text


def quadratic_energy(fluid: Fluid, state: np.ndarray) -> float:
    """Return <u.u>/2, plus c^2 <s^2>/2 for a compressible fluid, from the modes of a state; collective.

    <.> is the mean over the box, u the velocity minus its mean, and s = ln(rho / rho_0) minus its mean. The linear
    terms of the equations never raise this energy.
    """
    grid = fluid.grid
    energy = _half_square(grid, state[:3])
    if fluid.compressible:
        energy += fluid.sound_speed**2 * _half_square(grid, state[3:])
    return float(global_sum(grid.decomposition.comm, energy))


def _half_square(grid: SpectralGrid, modes: np.ndarray) -> float:
    # Stored modes count twice, except the plane kx = 0, which holds its own mirror images.
    plane = modes[..., 0] * (grid.index_squared[..., 0] > 0)
    rest = modes[..., 1:]
    return np.vdot(rest, rest).real + np.vdot(plane, plane).real / 2


class StabilityWatch:
    """Checks the energy after every step of a flow. The check costs one small message and 0.1 % of a step.

    `history` is the FlowHistory of the flow. Its rows are quoted in the advice for an unstable run.
    """

    def __init__(self, fluid: Fluid, stepper: Callable, history: Any) -> None:
        self.fluid, self.stepper, self.history = fluid, stepper, history
        self._ceiling: float | None = None  # the available energy; None before the first step

    def __call__(self, before: np.ndarray, after: np.ndarray, step: float, clock: Clock) -> None:
        """Raise FlowDiverged if the step from the state `before` to the state `after` was unstable.

        A step is unstable if the energy then exceeds GROWTH times the available energy. The available energy is the
        smallest energy so far plus the energy injected since then.
        """
        if self._ceiling is None:
            self._ceiling = quadratic_energy(self.fluid, before)
        if self.fluid.forcing is not None:
            self._ceiling += step * self.fluid.forcing.injection_rate
        energy = quadratic_energy(self.fluid, after)
        # A negated comparison, so that NaN fails too.
        if not energy <= GROWTH * self._ceiling < math.inf:
            seen = "its energy is no longer finite"
            if math.isfinite(energy):
                seen = f"its energy is {energy:.3g}, but the flow had only {self._ceiling:.3g}"
            raise FlowDiverged(seen, clock, self._advice(before, step))
        self._ceiling = min(self._ceiling, energy)

    def _advice(self, before: np.ndarray, step: float) -> str:
        speed = float(global_max(self.fluid.grid.decomposition.comm, advective_speed(self.fluid.grid, before[:3])))
        rows, stable = self.history.rows, {"kmax_eta": 0.0}
        if rows:  # the last row before the energy grew
            most = GROWTH * max(rows[0]["total_energy"], self._ceiling)
            stable = [row for row in rows if row["total_energy"] <= most][-1]
        limits = step_limits(self.fluid, self.stepper, step, speed)
        return advice(self.fluid, limits, stable["kmax_eta"], stable.get("mach_turbulent", 0.0))

    def state_dict(self) -> dict[str, float | None]:
        """Return the available energy, for a checkpoint; None before the first step."""
        return {"ceiling": self._ceiling}

    def load_state_dict(self, state: dict[str, float | None]) -> None:
        self._ceiling = state["ceiling"]
