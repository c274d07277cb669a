"""A flow on its way through time, with all that goes on from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from eddies.clock import Clock
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import Fluid
from eddies.flow.stability import StabilityWatch
from eddies.io.checkpoint import Checkpoint
from eddies.io.contiguous import Block
from eddies.io.guard import Guard

if TYPE_CHECKING:
    from eddies.workflows.ground_truth.tracer_run import TracerRun


@dataclass
class FlowRun:
    """A fluid with its state, the steps that it takes, its clock and its history.

    `guard` looks on before each step; after it `watch` ends a run that became unstable. `phase` is where it is on its
    way: in the "spin-up", at the "start" of what follows, in the "run" of a given time, or with "tracers", of
    which then `tracers` is the run.
    """

    fluid: Fluid
    state: np.ndarray
    stepper: Callable[[np.ndarray, float], np.ndarray]
    step_limit: CourantLimit | FixedStep
    history: FlowHistory
    guard: Guard
    clock: Clock = field(default_factory=Clock)
    phase: str = "start"
    tracers: TracerRun | None = None
    watch: StabilityWatch = field(init=False)

    def __post_init__(self) -> None:
        self.watch = StabilityWatch(self.fluid, self.stepper, self.history)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return self.clock.steps

    def begin_tracers(self, tracers: TracerRun, forced: bool) -> None:
        """Be in the phase in which tracers are followed: unless it stays `forced`, nothing forces the flow from here
        on."""
        self.phase, self.tracers = "tracers", tracers
        if not forced:
            self.fluid.forcing = None

    def advance(self, observers: Sequence[Callable], step_limit: Callable | None = None) -> None:
        """Take steps, of another limit if one is given, until the clock ends; every observer sees every step.

        Raises FlowDiverged at the step that was unstable.
        """
        while self.clock.running:
            self.guard(self, self.tracers.segments if self.tracers else None)
            step = (step_limit or self.step_limit)(self.state, self.clock)
            with np.errstate(over="ignore", invalid="ignore"):  # the watch says it better
                state = self.stepper(self.state, step)
                self.clock.tick(step)
                self.watch(self.state, state, step, self.clock)
            self.state = state
            for observer in observers:
                observer(self.state, self.clock)

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, for a checkpoint; with that of the tracers, if there are any."""
        grid = self.fluid.grid
        modes = Block(self.state, int(grid.column_starts[grid.decomposition.rank]), grid.modes, axis=2)
        return {"phase": self.phase, "modes": modes, "clock": self.clock.state_dict(),
                "step_limit": self.step_limit.state_dict(), "watch": self.watch.state_dict(),
                **self.history.state_dict(), **(self.tracers.state_dict() if self.tracers else {})}

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint, made on any number of ranks; tracers take what is theirs themselves."""
        grid = self.fluid.grid
        starts, rank = grid.column_starts, grid.decomposition.rank
        self.phase, self.state = saved["phase"], saved.read("modes", starts[rank], starts[rank + 1], axis=2)
        self.clock.load_state_dict(saved["clock"])
        self.step_limit.load_state_dict(saved["step_limit"])
        self.watch.load_state_dict(saved["watch"])
        self.history.load_state_dict(saved)
