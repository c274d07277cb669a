"""The limits of a time step by theory, and the watch that ends a run which is unstable, naming the limit it broke."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from eddies.clock import Clock
from eddies.errors import UserError
from eddies.flow.navier_stokes import Fluid, advective_speed
from eddies.parallel.reduction import global_max, global_sum
from eddies.time_stepping import RungeKutta4

# Where |1 + z + z^2/2 + z^3/6 + z^4/24| = 1 on the axes: the reach of a four-stage fourth-order Runge-Kutta method.
IMAGINARY_REACH, REAL_REACH = math.sqrt(8), 2.785293563405282

# From this advective number on ETDRK4 lets undamped sound grow by more than 0.1 % a step: see `step_limits`.
LEAK = 0.5

# The flow is unstable when it holds this many times the energy that there was or that came in. Generous, because for
# strong density fluctuations the quadratic energy looked at is several times the true one, or a fraction of it.
GROWTH = 10

EXACT = ', or take stepper = "etdrk4", which knows no such limit'
REMEDIES = {"advection": "lower courant or step", "sound": "lower courant or step" + EXACT,
            "viscosity": "lower max_step or step" + EXACT}


class FlowDiverged(UserError, RuntimeError):
    """The flow is not finite, or it gains energy from nowhere."""

    def __init__(self, seen: str, clock: Clock, advice: str) -> None:
        super().__init__(f"unstable at step {clock.steps}, time {clock.time:.6g}: {seen}. {advice}")

    @classmethod
    def unless_finite(cls, number: float, clock: Clock) -> None:
        """Raise it unless a number measured of a flow is finite; a flow that is watched hardly can but at its start."""
        if not math.isfinite(number):
            raise cls("the flow is not finite", clock, "Correct what it starts from: amplitude or path"
                      if clock.steps == 0 else "Lower courant or step, or raise cells or viscosity")


@dataclass(frozen=True)
class StepLimit:
    """A number that grows with the time step, and the boundary up to which the step is stable."""

    name: str
    expression: str
    number: float
    boundary: float

    @property
    def exceeded(self) -> bool:
        """Whether the number is beyond the boundary."""
        return self.number > self.boundary

    def __str__(self) -> str:
        return f"{self.name}, {self.expression} = {self.number:.3g}, stable up to {self.boundary:.3g}"


def step_limits(fluid: Fluid, stepper: Callable, step: float, speed: float) -> list[StepLimit]:
    """The limits of a step in a flow with the largest |u| + |v| + |w| = `speed`; k_max is the cutoff of each axis.

    The eigenvalues of the largest modulus, all at |k| = sqrt(3) k_max: advection i k_max (|u| + |v| + |w|), sound on
    top of it i sqrt(3) k_max c, viscosity -3 nu k_max^2, of a compressible fluid -4 nu k_max^2. RK4 has all of them to
    cope with, each alone up to where its region of stability meets the axis.

    ETDRK4 takes viscosity and sound exactly. Its region is that of RK4 without them. Viscosity widens it: with
    nu k^2 step = 1, 3 and 5 it reaches 3.2, 3.9 and 4.9, and much more of it 0.7 nu k^2 step. Undamped sound makes it
    leak: in a uniform flow of an advective number w below the boundary, waves of some c k step between 1 and 7 grow, at
    w = 0.5, 1, 1.5 and 2 by up to 0.1, 2, 7 and 15 % a step, which 2/3 nu k^2 step = 0.0013, 0.024, 0.1 and 0.22 stop.
    Turbulence, where few points move at the largest speed, took 60 steps at thrice the boundary without gaining energy
    tenfold, on 12^3 cells with M_t from 0.01 to 0.5.
    """
    grid = fluid.grid
    return limits_of_step(2 * math.pi / grid.decomposition.length * grid.cutoff, step, speed, fluid.viscosity,
                          isinstance(stepper, RungeKutta4), fluid.sound_speed if fluid.compressible else None)


def limits_of_step(k_max: float, step: float, speed: float, viscosity: float, explicit: bool,
                   sound_speed: float | None) -> list[StepLimit]:
    """The same by numbers: `explicit` of RK4, `sound_speed` None without sound."""
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
    """What an unstable run should change: for the limits that its step broke, or for the resolution if none; of a
    supersonic flow, with a turbulent Mach number above 1, the sound speed."""
    broken = [limit for limit in limits if limit.exceeded]
    if broken:
        return "Broken: " + "; ".join(f"{limit}: {REMEDIES[limit.name]}" for limit in broken)
    if mach > 1:
        return (f"The flow is supersonic, its turbulent Mach number was {mach:.2g}, and shocks are not resolved: raise "
                "sound_speed, or lower amplitude or injection_rate")
    resolution = f"k_max eta was {kmax_eta:.2g}, about 1 is needed" if fluid.viscosity > 0 else "there is no viscosity"
    text = ("The step broke no limit (" + "; ".join(map(str, limits)) + f"), so the grid is likely too coarse "
            f"({resolution}): raise cells or viscosity")
    if fluid.compressible and len(limits) == 1 and limits[0].number > LEAK:
        text += ". Or sound grows that is hardly damped: lower courant or step"
    return text


def quadratic_energy(fluid: Fluid, state: np.ndarray) -> float:
    """<u.u>/2, and for sound + c^2 <s^2>/2, which the linear terms never raise: one pass over the modes."""
    energy = _half_square(state[:3])
    if fluid.compressible:
        energy += fluid.sound_speed**2 * _half_square(state[3:])
    return float(global_sum(fluid.grid.decomposition.comm, energy))


def _half_square(modes: np.ndarray) -> float:
    # Twice the stored modes, but for the plane kx = 0, which holds its mirror images itself.
    plane = modes[..., 0]
    return np.vdot(modes, modes).real - np.vdot(plane, plane).real / 2


class Samples(Protocol):
    """What was measured of a flow, a row for each sample, as FlowHistory has it."""

    @property
    def rows(self) -> Sequence[Mapping[str, float]]: ...


class StabilityWatch:
    """Looks at the energy after every step of a flow, for a small message and 0.1 % of a step's work."""

    def __init__(self, fluid: Fluid, stepper: Callable, history: Samples) -> None:
        self.fluid, self.stepper, self.history = fluid, stepper, history
        self._ceiling = math.inf

    def __call__(self, before: np.ndarray, after: np.ndarray, step: float, clock: Clock) -> None:
        """Raise FlowDiverged if the step from `before` to `after`, which ended now, was unstable.

        The energy can be no larger than at any time before and what the forcing has put in since.
        """
        if self._ceiling == math.inf:
            self._ceiling = quadratic_energy(self.fluid, before)
        if self.fluid.forcing is not None:
            self._ceiling += step * self.fluid.forcing.injection_rate
        energy = quadratic_energy(self.fluid, after)
        # Written so that what is not finite fails.
        if not energy <= GROWTH * self._ceiling < math.inf:
            raise FlowDiverged(self._seen(energy), clock, self._advice(before, step))
        self._ceiling = min(self._ceiling, energy)

    def _seen(self, energy: float) -> str:
        if not math.isfinite(energy):
            return "its energy is no longer finite"
        return f"its energy is {energy:.3g}, and no more than {self._ceiling:.3g} was there or came in"

    def _advice(self, before: np.ndarray, step: float) -> str:
        speed = float(global_max(self.fluid.grid.decomposition.comm, advective_speed(self.fluid.grid, before[:3])))
        rows, was = self.history.rows, {"kmax_eta": 0.0}
        if rows:  # the flow as it was, not what became of it
            most = GROWTH * max(rows[0]["total_energy"], self._ceiling)
            was = [row for row in rows if row["total_energy"] <= most][-1]
        limits = step_limits(self.fluid, self.stepper, step, speed)
        return advice(self.fluid, limits, was["kmax_eta"], was.get("mach_turbulent", 0.0))

    def state_dict(self) -> dict[str, float | None]:
        """The most energy that there may be, for a checkpoint; None before the first step."""
        return {"ceiling": self._ceiling if math.isfinite(self._ceiling) else None}

    def load_state_dict(self, state: dict[str, float | None]) -> None:
        """Inverse of `state_dict`."""
        self._ceiling = math.inf if state["ceiling"] is None else state["ceiling"]
