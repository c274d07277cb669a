"""A flow on its way through time, and tracers in it, with all that goes on from a checkpoint."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from eddies.clock import Clock, ProgressLine
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import Fluid
from eddies.flow.stability import StabilityWatch
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.io.checkpoint import Block, Checkpoint, Guard
from eddies.io.frame_segments import FrameSegments
from eddies.parallel.migration import IdOrder, id_block, migrate
from eddies.particles.flow_units import MEAN_DENSITY, measured_scales
from eddies.scene.scene import Scene
from eddies.workflows.ground_truth.frame_counts import whole_frames
from eddies.workflows.ground_truth.tracer_frames import TracerFrames


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


class TracerRun:
    """Releases tracers into a flow, its forcing off unless [tracers] forced, or takes them from a checkpoint, and
    follows them.

    `released` is the sample of the flow at the release. Within a frame interval all steps are equal: the longest
    allowed ones that divide it, so that frames are equally spaced.
    """

    def __init__(self, scene: Scene, flow: FlowRun, segments: FrameSegments, saved: Checkpoint | None) -> None:
        self.scene, self.flow, self.segments, self.settings = scene, flow, segments, scene.tracers
        flow.begin_tracers(self, self.settings.forced)
        field = FilteredField(flow.fluid.grid, self.settings.filter_width, self.settings.interpolation)
        self.comm = flow.fluid.grid.decomposition.comm
        if saved is None:
            self.released, self.released_at = flow.history.sample(flow.state, flow.clock), flow.clock.time
            self.interval, self.step, self.first_step = 0, 0.0, flow.clock.steps
            slab = flow.fluid.grid.decomposition
            columns = release(slab, scene.seed, self.settings.particles_per_side, self.settings.placement)
            self.tracers = TracerParticles(field, columns, flow.state)
            self.frames = self._new_frames()
            self.frames.store(flow.state, flow.clock)
        else:
            self.released, self.released_at = saved["released"], saved["released_at"]
            self.interval, self.step, self.first_step = saved["interval"], saved["step"], saved["first_step"]
            self.tracers = TracerParticles(field, self._saved_columns(saved), flow.state)
            self.frames = self._new_frames()
            self.frames.load_state_dict(saved)

    @property
    def intervals(self) -> int:
        """Number of frame intervals, at least the one that the rates of the release are measured over."""
        duration = self.settings.turnovers * self.released["eddy_turnover_time"]
        return max(int(np.ceil(duration / self.settings.frame_interval - 1e-9)), 1)

    def follow(self) -> None:
        """Follow the tracers to the end of the last interval."""
        flow = self.flow
        progress = ProgressLine("tracers", flow.history.describe, done=self._done)
        if self.interval > 0:
            self._finish_interval(progress)
        while self.interval < self.intervals:
            self.interval += 1
            self.step = self._longest_step()
            flow.clock.end = flow.clock.time + self.settings.frame_interval
            self._finish_interval(progress)
        flow.history.sample(flow.state, flow.clock)

    def scales(self) -> dict[str, float]:
        """Scales of the filtered flow at the release, with the rates between the first two frames: what the same flow
        does later does not change them."""
        (start, first), (end, second) = self.segments.first_frames("tracers", 2)
        return {"released_at": self.released_at, "sound_speed": self.scene.flow.sound_speed or np.inf,
                "filter_width": self.settings.filter_width, "spacing": self.settings.spacing,
                "density_mean": MEAN_DENSITY, **measured_scales(self.comm, first, second, end - start)}

    def state_dict(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the flow and the files of `segments`."""
        order = IdOrder(self.comm, self.tracers.columns["id"], self.settings.particles)
        columns = {name: Block(order.apply(self.tracers.columns[name]), order.start, self.settings.particles)
                   for name in ("position", "velocity")}
        return {"released": self.released, "released_at": self.released_at, "interval": self.interval,
                "step": self.step, "first_step": self.first_step, **self.frames.state_dict(), **columns}

    def _new_frames(self) -> TracerFrames:
        return TracerFrames(self.segments, self.tracers, self.settings, self.released_at,
                            self.flow.fluid.compressible, whole_frames(self.scene, self.intervals + 1))

    def _longest_step(self) -> float:
        interval = self.settings.frame_interval
        longest = min(self.flow.step_limit.bound(self.flow.state, self.flow.clock), self.scene.time.max_step)
        return interval / int(np.ceil(interval / longest - 1e-9))

    @property
    def _done(self) -> float:
        return (self.flow.clock.time - self.released_at) / (self.intervals * self.settings.frame_interval)

    @property
    def _steps(self) -> int:
        return self.flow.clock.steps - self.first_step

    def _finish_interval(self, progress: ProgressLine) -> None:
        flow, step = self.flow, self.step
        flow.advance([flow.history, lambda state, _: self.tracers.advance(state, step),
                      lambda *_: progress(self._done, self._steps)], FixedStep(step))
        began = time.perf_counter()
        with progress.storing():
            self.frames.store(flow.state, flow.clock)
        flow.history.leave_out(time.perf_counter() - began)

    def _saved_columns(self, saved: Checkpoint) -> dict[str, np.ndarray]:
        """Each saved tracer on the rank whose slab holds it."""
        start, stop = id_block(self.comm, self.settings.particles)
        columns = {name: saved.read(name, start, stop) for name in ("position", "velocity")}
        return migrate(self.flow.fluid.grid.decomposition, {"id": np.arange(start, stop, dtype=np.int64), **columns})
