"""A flow on its way through time, with all that goes on from a checkpoint."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from eddies.clock import Clock
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import Fluid
from eddies.flow.stability import StabilityWatch
from eddies.io.checkpoint import Checkpoint, CheckpointDirectory
from eddies.io.contiguous import Block
from eddies.parallel.stop import Stopped, StopRequest


@dataclass
class FlowRun:
    """A fluid with its state, the steps that it takes, its clock and its history.

    `guard` looks on before each step; after it `watch` ends a run that became unstable.
    """

    fluid: Fluid
    state: np.ndarray
    stepper: Callable[[np.ndarray, float], np.ndarray]
    step_limit: CourantLimit | FixedStep
    history: FlowHistory
    guard: Callable[[FlowRun], None]
    clock: Clock = field(default_factory=Clock)
    watch: StabilityWatch = field(init=False)

    def __post_init__(self) -> None:
        self.watch = StabilityWatch(self.fluid, self.stepper, self.history)

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

    def restore(self, saved: Checkpoint) -> None:
        """Go on from a checkpoint, made on any number of ranks."""
        grid, known = self.fluid.grid, saved.description
        starts, rank = grid.column_starts, grid.decomposition.rank
        self.state = saved.read("modes", starts[rank], starts[rank + 1], axis=2)
        self.clock.restore(known["clock"])
        self.step_limit.restore(known["step_limit"])
        self.watch.restore(known["watch"])
        columns = {name: saved.read(f"history_{name}") for name in known["history_columns"]}
        self.history.restore(columns, saved.read("spectra_of_history"), known["history"])

    def memory(self) -> tuple[dict[str, Any], dict[str, np.ndarray | Block]]:
        """What `restore` needs: a description and arrays."""
        grid = self.fluid.grid
        columns = self.history.columns()
        arrays = {"modes": Block(self.state, int(grid.column_starts[grid.decomposition.rank]), grid.modes, axis=2),
                  "spectra_of_history": np.array(self.history.spectra),
                  **{f"history_{name}": values for name, values in columns.items()}}
        return {"clock": self.clock.state(), "step_limit": self.step_limit.memory(), "watch": self.watch.memory(),
                "history": self.history.memory(), "history_columns": list(columns)}, arrays


class Guard:
    """Writes checkpoints of a run when they are due, and ends it when it is asked to.

    `tracers`, as soon as there are any, adds what it knows.
    """

    def __init__(self, comm, directory: Path, fingerprint: str, stop: StopRequest) -> None:
        self.checkpoints = CheckpointDirectory(comm, directory, fingerprint)
        self.stop, self.tracers = stop, None

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
        description, arrays = run.memory()
        files: list[str] = []
        if self.tracers is not None:
            known, more, files = self.tracers.memory()
            description, arrays = {**description, "tracers": known}, {**arrays, **more}
        self.checkpoints.write(run.clock.steps, description, arrays, files)
