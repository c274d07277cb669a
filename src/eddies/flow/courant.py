"""Time step of a flow: given by the Courant number, or fixed."""

import numpy as np

from eddies.clock import Clock, ladder_step
from eddies.flow.navier_stokes import advective_speed
from eddies.flow.stability import FlowDiverged
from eddies.parallel.reduction import global_max
from eddies.spectral.spectral_grid import SpectralGrid


EVERY = 8  # steps between two measurements of the speed


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
