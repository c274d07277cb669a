"""The time step that the flow allows."""

from __future__ import annotations

import numpy as np

from eddies.clock import Clock, ladder_step
from eddies.flow.navier_stokes import advective_speed
from eddies.flow.stability import FlowDiverged
from eddies.parallel.reduction import global_max
from eddies.spectral.spectral_grid import SpectralGrid


class CourantLimit:
    """Steps from the ladder largest * 2^-m with  step * (max(|u| + |v| + |w|) + sqrt(3) c) <= courant * dx.

    `sound_speed` c is counted for a stepper that treats sound explicitly only (0 otherwise); sqrt(3) because sound that
    runs diagonally has the largest wavenumber (`stability.step_limits`). The speed is measured every `every` steps.
    """

    def __init__(self, grid: SpectralGrid, courant: float, largest: float, sound_speed: float = 0.0,
                 every: int = 8) -> None:
        self.grid, self.courant, self.largest, self.sound_speed, self.every = grid, courant, largest, sound_speed, every
        self._bound = 0.0

    def __call__(self, state: np.ndarray, clock: Clock) -> float:
        """The next step: from the ladder, shortened to end at the clock's end."""
        if clock.steps % self.every == 0 or self._bound == 0.0:
            self._bound = self.bound(state, clock)
        return min(ladder_step(self.largest, self._bound), clock.remaining)

    def state_dict(self) -> dict[str, float]:
        """What the next step depends on besides the flow, for a checkpoint."""
        return {"bound": self._bound}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Inverse of `state_dict`."""
        self._bound = state["bound"]

    def bound(self, state: np.ndarray, clock: Clock) -> float:
        """The longest step that the Courant number allows now; FlowDiverged if the flow is not finite."""
        speed = float(global_max(self.grid.decomposition.comm, advective_speed(self.grid, state[:3])))
        FlowDiverged.unless_finite(speed, clock)
        speed += np.sqrt(3) * self.sound_speed
        return self.courant * self.grid.decomposition.spacing / speed if speed > 0 else np.inf


class FixedStep:
    """The same step always, but for the last, which ends at the clock's end."""

    def __init__(self, step: float) -> None:
        self.step = step

    def __call__(self, state: np.ndarray, clock: Clock) -> float:
        """The next step."""
        # A remainder within round-off of the step is the step: another size would need operators of its own.
        return self.step if clock.remaining > self.step * (1 - 1e-6) else clock.remaining

    def state_dict(self) -> dict[str, float]:
        """Nothing: the step is a setting."""
        return {}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Nothing to remember."""

    def bound(self, state: np.ndarray, clock: Clock) -> float:
        """The longest step."""
        return self.step
