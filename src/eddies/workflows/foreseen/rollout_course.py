"""How a rollout goes: its frames, its steps between them, and how often rates are evaluated for both."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from eddies.scene.methods import METHODS
from eddies.scene.scene import BOX_LENGTH, Eulerian, Scene
from eddies.workflows.foreseen.estimates import expected_turbulence, foreseen_allowed_step, peak_speed


@dataclass(frozen=True)
class RolloutCourse:
    """A rollout of so many frame intervals that takes steps of one size, with a start frame beside.

    Parameters
    ----------
    turnover_time : of the flow that it starts from.
    interval : time between frames. intervals : how many.
    step : longest time step.
    stages : evaluations in a step; 0 where nothing evaluates rates of particles, as on a coarse grid.
    dense : whether frames may lie between the ends of steps; if not, steps are equal parts of an interval.
    """

    turnover_time: float
    interval: float
    intervals: int
    step: float
    stages: int
    dense: bool

    @property
    def time_step(self) -> float:
        """The step that is taken."""
        return self.step if self.dense else self.interval / self._within_interval

    @property
    def steps_to_frames(self) -> np.ndarray:
        """Steps taken when each frame is reached, (intervals + 1,)."""
        numbers = np.arange(self.intervals + 1)
        if not self.dense:
            return numbers * self._within_interval
        return np.ceil(numbers * self.interval / self.step - 1e-9).astype(int)

    @property
    def steps(self) -> int:
        """Steps of the whole rollout."""
        return int(self.steps_to_frames[-1])

    @property
    def steps_per_frame(self) -> float:
        """The mean number of steps between two frames."""
        return self.steps / self.intervals

    @property
    def evaluations(self) -> int:
        """Evaluations of the rates for the steps, as rollout.h5 counts them: the first step is evaluated at its start
        as well, and with `dense` steps the last at its end."""
        return self.stages * self.steps + 1 if self.stages else 0

    @property
    def evaluations_of_frames(self) -> int:
        """Evaluations for frames alone: those that lie between steps, or, where steps keep no rates, all."""
        if not self.stages or not self.dense:
            return self.intervals + 1 if self.stages else 0
        reached = np.arange(self.intervals + 1) * self.interval
        return int(np.sum(self.steps_to_frames * self.step > reached * (1 + 1e-6)))

    @property
    def evaluations_per_turnover(self) -> float:
        """Evaluations for the steps of a turnover."""
        return self.evaluations * self.turnover_time / (self.intervals * self.interval)

    @property
    def _within_interval(self) -> int:
        return math.ceil(self.interval / self.step - 1e-9)


def rollout_course(scene: Scene, turnover_time: float | None = None) -> RolloutCourse | None:
    """The course of a scene's rollout, in a flow of the turnover time that is expected or given; None without a
    rollout, where the turnover time is not foreseen, or where what moves the particles is the user's."""
    settings, turbulence = scene.simulation, expected_turbulence(scene)
    if settings is None or settings.method not in METHODS or turbulence is None and turnover_time is None:
        return None
    turnover_time = turnover_time or turbulence.turnover_time
    intervals = math.ceil(settings.turnovers * turnover_time / settings.frame_interval - 1e-9)
    on_grid = settings.on_grid
    return RolloutCourse(turnover_time, settings.frame_interval, intervals, rollout_step(scene),
                         0 if on_grid else settings.scheme.evaluations,
                         not on_grid and settings.scheme.dense)


def rollout_step(scene: Scene) -> float:
    """The time step of the particles: the scene's, or where that is less what their resolved velocity can follow, or
    the Courant number on a coarse grid allows."""
    settings = scene.simulation
    allowed = None
    if settings.on_grid:
        cells, speed = (scene.eulerian or Eulerian()).cells_for(scene.tracers.filter_width), peak_speed(scene)
        allowed = speed and scene.time.courant * BOX_LENGTH / cells / speed
    elif "model" in settings.needs and scene.resolves:
        allowed = foreseen_allowed_step(scene)
    return min(settings.step, allowed or math.inf)
