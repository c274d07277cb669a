"""A flow on its way through time, with all that goes on from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eddies.clock import Clock
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import Fluid
from eddies.flow.stability import StabilityWatch
from eddies.io.checkpoint import Checkpoint, CheckpointDirectory
from eddies.io.contiguous import Block
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import Stopped, StopRequest

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

    def begin_tracers(self, tracers: TracerRun) -> None:
        """Be in the phase in which tracers are followed: nothing forces the flow from here on."""
        self.phase, self.tracers, self.fluid.forcing = "tracers", tracers, None

    def advance(self, observers: Sequence[Callable], step_limit: Callable | None = None) -> None:
        """Take steps, of another limit if one is given, until the clock ends; every observer sees every step.

        Raises FlowDiverged at the step that was unstable.
        """
        while self.clock.running:
            self.guard(self)
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


class Guard:
    """Writes checkpoints of a run when they are due, and ends it when it is asked to."""

    def __init__(self, comm: Comm, directory: Path, fingerprint: str, stop: StopRequest) -> None:
        self.checkpoints = CheckpointDirectory(comm, directory, fingerprint)
        self.stop = stop

    def __call__(self, run: FlowRun) -> None:
        """Look whether something is due; raises Stopped once the checkpoint is safe."""
        stopping = self.stop()
        if self.stop.checkpoint_due:
            self.save(run)
            self.stop.checkpoint_done()
        if stopping:
            raise Stopped(self.stop.reason, f"from step {run.clock.steps}")

    def save(self, run: FlowRun) -> None:
        """Write a checkpoint of now."""
        files: list[str] = []
        if run.tracers is not None:
            run.tracers.segments.close()
            files = run.tracers.segments.names
        self.checkpoints.write(run.clock.steps, run.state_dict(), files)
