"""A run of the direct simulation, with or without tracers. It stores frames of the tracers, and can be continued."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from eddies.clock import Clock, ProgressLine, rounded_up
from eddies.flow.stability import CourantLimit, FixedStep, StabilityWatch
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import Fluid
from eddies.flow.statistics import energy_spectrum
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.io.checkpoint import Block, Checkpoint, Guard
from eddies.io.flow_states import restored_modes, saved_modes
from eddies.io.frame_segments import FieldLayout, FrameLayout, FrameSegments, TrajectoryLayout
from eddies.io.hdf5 import File, Table, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder, id_block, migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition, block_starts
from eddies.particles.flow_units import MEAN_DENSITY, measured_scales
from eddies.scene.scene import BOX_LENGTH, Tracers
from eddies.spectral.spectral_grid import SpectralGrid, regrid
from eddies.workflows.ground_truth.frame_counts import whole_cells


@dataclass
class FlowRun:
    """A fluid and its state, the time stepper, the clock and the history of statistics.

    `guard` is called before each step, and writes checkpoints. `watch` is called after each step, and ends an unstable
    run. `phase` is "spin-up", "start" (before the next phase begins), "run" or "tracers" (then `tracers` is set).
    `max_step` limits the steps with tracers, in addition to `step_limit`.
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
    max_step: float = np.inf
    watch: StabilityWatch = field(init=False)

    def __post_init__(self) -> None:
        self.watch = StabilityWatch(self.fluid, self.stepper, self.history)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return self.clock.steps

    def advance(self, observers: Sequence[Callable], step_limit: Callable | None = None) -> None:
        """Take steps until the clock ends, and call each observer after each step.

        If `step_limit` is given, it replaces the step limit of the run. Raises FlowDiverged at an unstable step.
        """
        while self.clock.running:
            self.guard(self, self.tracers.segments if self.tracers else None)
            step = (step_limit or self.step_limit)(self.state, self.clock)
            with np.errstate(over="ignore", invalid="ignore"):  # the watch reports both faults
                state = self.stepper(self.state, step)
                self.clock.tick(step)
                self.watch(self.state, state, step, self.clock)
            self.state = state
            for observer in observers:
                observer(self.state, self.clock)

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, with the state of the tracers."""
        modes = saved_modes(self.fluid.grid, self.state)
        return {"phase": self.phase, "modes": modes, "clock": self.clock.state_dict(),
                "step_limit": self.step_limit.state_dict(), "watch": self.watch.state_dict(),
                **self.history.state_dict(), **(self.tracers.state_dict() if self.tracers else {})}

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Continue from a checkpoint that was made on any number of ranks. The tracers read their own state."""
        self.phase = saved["phase"]
        self.state = restored_modes(self.fluid.grid, saved, 4)
        self.clock.load_state_dict(saved["clock"])
        self.step_limit.load_state_dict(saved["step_limit"])
        self.watch.load_state_dict(saved["watch"])
        self.history.load_state_dict(saved)


class TracerSet:
    """The tracers of one set, and the filtered fields and energy spectra that are stored with them.

    Parameters
    ----------
    fluid, state : the flow.
    settings, seed : settings of the set, and the seed of random positions.
    saved : the checkpoint, or None to release new particles.
    suffix : added to the names of the set's series in segments and of its arrays in checkpoints (`suffix_of`).
    """

    def __init__(self, fluid: Fluid, state: np.ndarray, settings: Tracers, seed: int, saved: Checkpoint | None,
                 suffix: str) -> None:
        self.fluid, self.settings, self.suffix = fluid, settings, suffix
        slab, filters = fluid.grid.decomposition, FilteredField(fluid.grid, settings.filter_width,
                                                                settings.interpolation)
        self.comm, self.filtered = slab.comm, filters
        if saved is None:
            columns = release(slab, seed + settings.seed, settings.particles, settings.placement)
        else:
            start, stop = id_block(self.comm, settings.particles)
            block = {name: saved.read(name + suffix, start, stop) for name in ("position", "velocity")}
            columns = migrate(slab, {"id": np.arange(start, stop, dtype=np.int64), **block})
        followed = filters if settings.filtered else FilteredField(fluid.grid, 0.0, settings.interpolation)
        self.tracers, self.coarse = TracerParticles(followed, columns, state), grid_of(fluid.grid, settings.cells)
        names = "time", "energy", "filtered"
        self.spectra = {name: [] if saved is None else list(saved[f"spectra_{name}{suffix}"]) for name in names}

    def store(self, segments: FrameSegments, state: np.ndarray, step: int, time: float, with_fields: bool) -> None:
        """Store the particles and, if `with_fields`, the filtered fields and the spectra. `step` is the number of the
        step, and `time` is the time since the release."""
        columns, compressible = self.tracers.columns, self.fluid.compressible
        order = IdOrder(self.comm, columns["id"], self.settings.particles)
        frame = {name: order.apply(columns[name]) for name in ("position", "velocity")}
        if compressible:
            frame["density"] = order.apply(self.tracers.density(state))
        segments.trajectories[f"tracers{self.suffix}"].append(step, time, order.start, frame)
        if not with_fields:
            return
        field, grid = self.filtered, self.coarse
        velocity = field.transfer * state[:3]
        modes = {"velocity": velocity} | ({"density": field.density_modes(state)} if compressible else {})
        planes = {name: grid.backward(regrid(field.grid, grid, part)) for name, part in modes.items()}
        segments.fields[f"filtered{self.suffix}"].append(time, grid.decomposition.start, planes)
        for name, value in (("time", time), ("energy", energy_spectrum(field.grid, state[:3])),
                            ("filtered", energy_spectrum(field.grid, velocity))):
            self.spectra[name].append(value)

    def scales(self, segments: FrameSegments) -> dict[str, float]:
        """Return the scales of the particles at the release. Rates are differences between the first two frames, so the
        scales do not depend on the rest of the run."""
        (start, first), (end, second) = segments.first_frames(f"tracers{self.suffix}", 2)
        return {"filter_width": self.settings.filter_width, "spacing": self.settings.spacing,
                "density_mean": MEAN_DENSITY, **measured_scales(self.comm, first, second, end - start)}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, without the frames."""
        order = IdOrder(self.comm, self.tracers.columns["id"], self.settings.particles)
        columns = {name: Block(order.apply(self.tracers.columns[name]), order.start, self.settings.particles)
                   for name in ("position", "velocity")}
        spectra = {f"spectra_{name}": np.array(rows) for name, rows in self.spectra.items()}
        return {name + self.suffix: value for name, value in (columns | spectra).items()}

    def write_spectra(self, file: File) -> None:
        """Write the table of unfiltered and filtered energy spectra."""
        write_spectra(file, "spectra", "time", self.spectra)


class TracerRun:
    """Releases tracers into a flow, or takes them from a checkpoint, and follows them to the end.

    All steps within a frame interval are equal. They are the longest allowed steps that divide the interval, so frames
    are equally spaced in time. `released` holds the statistics of the flow at the release. `sets` holds the sets by
    name; the name of a single set is "".

    Parameters
    ----------
    flow : the run of the flow. Its forcing ends at the release unless [tracers] forced is true.
    segments : the files for the frames.
    settings, seed : [tracers], and the seed of random positions.
    whole : function that takes the number of frames, and returns the numbers of those frames that also store the
        unfiltered flow. All of these frames have filtered fields.
    saved : the checkpoint, or None.
    """

    def __init__(self, flow: FlowRun, segments: FrameSegments, settings: Tracers, seed: int,
                 whole: Callable[[int], Collection[int]], saved: Checkpoint | None) -> None:
        self.flow, self.segments, self.settings = flow, segments, settings
        flow.phase, flow.tracers = "tracers", self
        if not settings.forced:
            flow.fluid.forcing = None
        if saved is None:
            self.released, self.released_at = flow.history.sample(flow.state, flow.clock), flow.clock.time
            self.interval, self.step, self.first_step = 0, 0.0, flow.clock.steps
            flow.clock.begin()
        else:
            self.released, self.released_at = saved["released"], saved["released_at"]
            self.interval, self.step, self.first_step = saved["interval"], saved["step"], saved["first_step"]
        self.sets = {name: TracerSet(flow.fluid, flow.state, own, seed, saved, suffix_of(name))
                     for name, own in (settings.sets or {"": settings}).items()}
        self.whole, self.stored = whole(self.intervals + 1), 0 if saved is None else saved["frames"]
        if saved is None:
            self._store()

    @property
    def intervals(self) -> int:
        """Number of frame intervals. There is at least one, because the rates at the release are measured over the
        first one."""
        duration = self.settings.turnovers * self.released["eddy_turnover_time"]
        return max(rounded_up(duration / self.settings.frame_interval), 1)

    def follow(self) -> None:
        """Follow the tracers to the end of the last interval."""
        flow = self.flow
        progress = ProgressLine("tracers", flow.history.describe, done=self._done)
        if self.stored <= self.interval:  # the checkpoint was made within an interval
            self._finish_interval(progress)
        while self.interval < self.intervals:
            self.interval += 1
            self.step = self._longest_step()
            flow.clock.begin(self.settings.frame_interval)
            self._finish_interval(progress)

    def scales(self, name: str) -> dict[str, float]:
        """Return the scales of the flow, and those of the particles in the set `name`. Both belong to the release."""
        return {"released_at": self.released_at, "sound_speed": self.flow.fluid.sound_speed,
                **self.sets[name].scales(self.segments)}

    def state_dict(self) -> dict[str, Any]:
        """Return the state of the tracers for a checkpoint, without the flow and without the files of frames."""
        found = {"released": self.released, "released_at": self.released_at, "interval": self.interval,
                 "step": self.step, "first_step": self.first_step, "frames": self.stored}
        for each in self.sets.values():
            found |= each.state_dict()
        return found

    def _longest_step(self) -> float:
        interval = self.settings.frame_interval
        longest = min(self.flow.step_limit.bound(self.flow.state, self.flow.clock), self.flow.max_step)
        return interval / rounded_up(interval / longest)

    @property
    def _done(self) -> float:
        of_interval = self.flow.clock.elapsed / self.settings.frame_interval
        return (max(self.interval - 1, 0) + of_interval) / self.intervals

    def _finish_interval(self, progress: ProgressLine) -> None:
        flow, step = self.flow, self.step
        flow.advance([flow.history, *(lambda state, _, each=each: each.tracers.advance(state, step)
                                      for each in self.sets.values()),
                      lambda *_: progress(self._done, flow.clock.steps - self.first_step)], FixedStep(step))
        began = time.perf_counter()
        with progress.storing():
            self._store()
        flow.history.leave_out(time.perf_counter() - began)

    def _store(self) -> None:
        """Store a frame, with filtered fields and spectra in every `field_every`-th frame. Times count from the
        release."""
        state, fluid, time_since = self.flow.state, self.flow.fluid, self.interval * self.settings.frame_interval
        steps, with_fields = self.flow.clock.steps, self.stored % self.settings.field_every == 0
        self.segments.open(steps)
        for each in self.sets.values():
            each.store(self.segments, state, steps, time_since, with_fields)
        if with_fields and self.stored in self.whole:
            # Velocity and density on the smallest grid that holds all their modes.
            grid = grid_of(fluid.grid, whole_cells(fluid.grid.cutoff))
            values = grid.backward(regrid(fluid.grid, grid, state))
            planes = {"velocity": values[:3]} | ({"density": np.exp(values[3:])} if fluid.compressible else {})
            self.segments.fields["unfiltered"].append(time_since, grid.decomposition.start, planes)
        self.stored += 1


def grid_of(fine: SpectralGrid, cells: int) -> SpectralGrid:
    """Return a grid with `cells` cells along each axis. It keeps those modes of the grid `fine` that it can hold."""
    slab = SlabDecomposition(fine.decomposition.comm, fine.decomposition.length, cells)
    return SpectralGrid(slab, fine.precision, min(fine.cutoff, (cells - 1) // 2))


def suffix_of(name: str) -> str:
    """Return the suffix that marks the series and arrays of a set of tracers: "-NAME", or "" for a single set, whose
    name is ""."""
    return name and f"-{name}"


def frame_layout(settings: Tracers, compressible: bool, cutoff: int) -> FrameLayout:
    """Return the layout of the frames of all sets. `cutoff` is the largest wavenumber of the unfiltered flow."""
    columns, variables = {"position": (3,), "velocity": (3,)}, {"velocity": 3}
    if compressible:
        columns, variables = columns | {"density": ()}, variables | {"density": 1}
    sets = {suffix_of(name): each for name, each in (settings.sets or {"": settings}).items()}
    return FrameLayout(
        BOX_LENGTH, {f"tracers{end}": TrajectoryLayout(each.particles, columns) for end, each in sets.items()},
        np.float64, {f"filtered{end}": FieldLayout(each.cells, variables) for end, each in sets.items()}
        | {"unfiltered": FieldLayout(whole_cells(cutoff), variables)})


def write_spectra(file: File, name: str, rows: str, columns: Mapping[str, ArrayLike]) -> None:
    """Write a table of energy spectra E(k), k = 0, 1, ...; `rows` names the axis of the rows."""
    wavenumber = np.arange(len(columns["energy"][0]))
    write_table(file, name, Table({"wavenumber": wavenumber, **columns}, f"{rows} wavenumber", {
        "time": "T", "wavenumber": "1/L", "energy": "L^2/T^2", "filtered": "L^2/T^2"}))


def series_of(name: str) -> dict[str, str]:
    """Map the names of a set's series in `frame_layout` to their names in the ground truth of this set."""
    return {f"{series}{suffix_of(name)}": series for series in ("tracers", "filtered")} | {"unfiltered": "unfiltered"}


def saved_rows(comm: Comm, columns: Mapping[str, np.ndarray]) -> dict[str, Any]:
    """Return the columns (n, ...) of this rank as a state for a checkpoint. Rows are stored in the order of the ranks.

    `columns` holds at least `id` and `position`. Collective.
    """
    rows = np.zeros(comm.size, np.int64)
    rows[comm.rank] = len(columns["id"])
    rows = global_sum(comm, rows)
    first, total = int(rows[:comm.rank].sum()), int(rows.sum())
    return {"columns": list(columns), "rows_of_ranks": rows,
            **{f"particles {name}": Block(column, first, total) for name, column in columns.items()}}


def restored_rows(slab: SlabDecomposition, saved: Checkpoint) -> tuple[dict[str, np.ndarray], bool]:
    """Return the columns of this rank, and whether they are exactly the rows that this rank saved.

    On the same number of ranks each rank reads the rows that it saved, in the same order. Therefore a restart does not
    change the last bit of a sum over particles. On another number of ranks the columns are those of the particles in
    this rank's slab. Collective.
    """
    rows = saved["rows_of_ranks"]
    same = len(rows) == slab.size
    starts = np.concatenate([[0], np.cumsum(rows)]) if same else block_starts(int(rows.sum()), slab.size)
    block = int(starts[slab.rank]), int(starts[slab.rank + 1])
    columns = {name: saved.read(f"particles {name}", *block) for name in saved["columns"]}
    return (columns if same else migrate(slab, columns)), same
