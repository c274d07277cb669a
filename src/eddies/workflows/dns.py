"""`eddies dns`: make a ground truth by direct numerical simulation, with spin-up, filter and tracers."""

import logging
from collections.abc import Mapping
from contextlib import ExitStack, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np

from eddies.clock import ROUND_OFF, Clock, ProgressLine
from eddies.flow.history import OF_THE_RUN, UNITS, FlowHistory
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.fields import FieldWriter
from eddies.io.frame_segments import FrameSegments
from eddies.io.hdf5 import File, ProductError, Table, create_product, in_files, open_product, write_table
from eddies.io.new_files import set_attributes, write_files
from eddies.io.provenance import product_fingerprint, product_provenance
from eddies.io.run_lock import lock_directory
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, SceneError
from eddies.scene.sections import Forcing, SpinUp, Time
from eddies.time_stepping import STEPPERS
from eddies.workflows.ground_truth.flow_run import FlowRun, TracerRun, frame_layout, series_of, write_spectra
from eddies.workflows.ground_truth.frame_counts import unfiltered_frames
from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
from eddies.workflows.problems import check_span
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate the flow of a scene and write ground_truth.h5: statistics and, with [tracers], frames and fields. With
    [tracks] the ground truth is that of the measured tracks (`tracks.run`).

    With sets of tracers, each set gets its own ground truth SET/ground_truth.h5, as if it were the only set. The ground
    truth of the run directory then has no tracers.

    The flow is first spun up ([spin_up]). The forcing ends at the release of the tracers, unless [tracers] forced is
    true. The run continues from the newest checkpoint with the same settings; only the duration of the run may differ.
    Without sets, the last state is kept as a checkpoint, and the product holds the frames up to this state.

    Raises SceneError if the checkpoint is later than the end of the run, and Stopped, after a checkpoint, if `stop`
    requests it.
    """
    if scene.tracks is not None:
        from eddies.workflows import tracks  # imports torch
        tracks.run(scene, comm, directory, stop)
        return
    directory, sets = Path(directory), scene.tracer_sets
    stage = STAGES["dns"]
    product, course = directory / stage.file, stage_fingerprint(scene, "dns", stage.duration)
    guard = Guard(comm, directory / stage.checkpoints, course, stop)
    provenance = {**stage_provenance(scene, "dns"), "course": course, "duration": scene.duration}
    saved, kept = checkpoint_to_continue(guard, product, course)
    if saved is not None and kept and scene.tracers is not None:
        provenance["id"] = kept  # the frames so far do not change, so products made from them stay valid
    flow = flow_of(scene, guard, saved)
    with ExitStack() as held:
        for name in sets:
            held.enter_context(lock_directory(comm, directory / name))
        file = held.enter_context(create_product(comm, product, "ground_truth", provenance))
        if saved is None:
            flow.history.sample(flow.state, flow.clock)
        if flow.phase == "spin-up":
            spin_up(flow, scene.spin_up.turnovers, scene.time)
        if scene.tracers is None:
            run_for(flow, scene.time)
        else:
            tracers = released(flow, scene, product, saved, held)
            tracers.follow()
        final, last = flow.state_dict(), flow.history.sample(flow.state, flow.clock)
        for name, own in sets.items():
            write_set(directory / name / product.name, own, tracers, name)
        if scene.tracers is None or sets:
            write_final_fields(file, flow)
            scales = scales_of(last)
        else:
            write_tracers(file, tracers, "", scene.forcing)
            scales = scales_of(tracers.released) | tracers.scales("")
        write_flow(file, flow, scales, scene.spin_up)
    guard.checkpoints.remove()
    if not sets:
        guard.checkpoints.write(flow.steps, final)


def checkpoint_to_continue(guard: Guard, product: Path, course: str) -> tuple[Checkpoint | None, str]:
    """Return the newest checkpoint that a run can continue from, or None, and the id of a product of the same course,
    or an empty string; collective.

    A checkpoint without frames needs those in the product, up to its own time. If they are missing, it is removed with
    a warning.
    """
    comm, saved = guard.checkpoints.comm, guard.checkpoints.newest()
    origin = on_first_rank(comm, lambda: product_provenance(product))
    kept = origin["id"] if origin.get("course") == course else ""
    if saved is not None and saved["phase"] == "tracers" and not saved.files and not (
            kept and holds_frames(comm, product, saved["frames"])):
        if comm.rank == 0:
            log.warning("%s: lacks the frames before the checkpoint, so the checkpoint is not used", product)
        guard.checkpoints.remove()
        saved = None
    return saved, kept


def flow_of(scene: Scene, guard: Guard, saved: Checkpoint | None) -> FlowRun:
    """Return the flow of a scene at its start or at a checkpoint; collective."""
    fluid = build_fluid(scene.flow, scene.forcing, guard.checkpoints.comm)
    state = initial_state(scene.initial, scene.seed, fluid) if saved is None else None
    flow = FlowRun(fluid, state, STEPPERS[scene.time.stepper](fluid),
                   build_step_limit(scene.time, scene.flow, fluid.grid), FlowHistory(fluid), guard,
                   phase="start" if scene.spin_up is None else "spin-up", max_step=scene.time.max_step)
    if saved is not None:
        flow.load_state_dict(saved)
        log.info("dns: continues from step %d, time %.4g", flow.clock.steps, flow.clock.time)
    return flow


def released(flow: FlowRun, scene: Scene, product: Path, saved: Checkpoint | None, held: ExitStack) -> TracerRun:
    """Return the tracers of a scene, released now or at a checkpoint. `held` closes the file of their frames.

    Raises SceneError if the flow is at rest, if the time to follow them takes too many steps, or if the checkpoint is
    later than its end.
    """
    if flow.phase != "tracers":
        saved = None
        span = scene.tracers.turnovers * flow.history.sample(flow.state, flow.clock)["eddy_turnover_time"]
        check_span(scene.time, flow.clock.time, span, flow.step_limit.bound(flow.state, flow.clock), scene.tracers)
    layout = frame_layout(scene.tracers, flow.fluid.compressible, flow.fluid.grid.cutoff)
    before = () if saved is None else saved.files or [f"../{product.name}"]
    parts = held.enter_context(FrameSegments(flow.guard.checkpoints.comm, flow.guard.checkpoints.path, layout, before))
    whole = partial(unfiltered_frames, scene.simulation, scene.training, scene.tracers.field_every)
    tracers = TracerRun(flow, parts, scene.tracers, scene.seed, whole, saved)
    if tracers.interval > tracers.intervals:
        raise too_late(flow.guard, f"[tracers] turnovers = {scene.tracers.turnovers:g}")
    return tracers


def write_set(path: Path, own: Scene, tracers: TracerRun, name: str) -> None:
    """Write the ground truth of the set of tracers `name`, whose scene is `own`; collective. A file with the same
    settings is kept, so that products made from it stay valid. So is a scene.toml beside it."""
    comm, flow = tracers.flow.guard.checkpoints.comm, tracers.flow
    if in_files(comm, path, partial(product_fingerprint, path)) == stage_fingerprint(own, "dns"):
        return
    scene = path.parent / "scene.toml"
    in_files(comm, path, lambda: scene.exists() or write_files({scene: own.to_toml()}))
    with create_product(comm, path, "ground_truth", stage_provenance(own, "dns")) as part:
        write_tracers(part, tracers, name, own.forcing)
        write_flow(part, flow, scales_of(tracers.released) | tracers.scales(name), own.spin_up)


def write_tracers(file: File, tracers: TracerRun, name: str, forcing: Forcing | None) -> None:
    """Write the frames, fields and spectra of the set of tracers `name`; collective. If the flow is forced after the
    release, `forcing` is written, too."""
    tracers.segments.assemble(file, series_of(name))
    if tracers.flow.fluid.forcing is not None:
        set_attributes(file.create_group("forcing"), asdict(forcing))
    tracers.sets[name].write_spectra(file)


def write_flow(file: File, flow: FlowRun, scales: Mapping[str, float], spin_up: SpinUp | None) -> None:
    """Write the scales and the statistics of a flow; collective."""
    set_attributes(file.create_group("reference"), {
        **scales, "viscosity": flow.fluid.viscosity, "energy_budget_error": flow.history.budget_error})
    write_table(file, "statistics", Table(flow.history.columns(), units=UNITS))
    write_spectra(file, "spectra_of_statistics", "row", {"energy": flow.history.spectra})
    if spin_up is not None and spin_up.stationary is not None:
        set_attributes(file.create_group("stationary"), stationary_span(spin_up, flow.history))


def holds_frames(comm: Comm, product: Path, count: int) -> bool:
    """Return whether a ground truth exists and has exactly `count` frames; collective."""
    with suppress(ProductError), open_product(comm, product, "ground_truth") as file:
        return len(Trajectory(file, "tracers").times) == count
    return False


def too_late(guard: Guard, key: str) -> SceneError:
    """Return the error for a checkpoint that is later than the end of the run."""
    return SceneError(f"{key}: the checkpoint in {guard.checkpoints.path} is later than this end of the run; raise the "
                      "key, or remove that directory to simulate from the beginning")


def run_for(flow: FlowRun, time: Time) -> None:
    """Run the flow for [time] duration after its start or after the spin-up.

    Raises SceneError if this takes too many steps, or if the flow has already passed the end.
    """
    clock, duration = flow.clock, time.duration
    if flow.phase == "start":
        check_span(time, clock.time, duration, flow.step_limit.bound(flow.state, clock))
        flow.phase = "run"
        clock.begin()
    elif clock.elapsed > duration * (1 + ROUND_OFF):
        raise too_late(flow.guard, f"[time] duration = {duration:g}")
    clock.span = duration
    progress = ProgressLine("dns", flow.history.describe, done=clock.elapsed / duration)
    flow.advance([flow.history, lambda _, clock: progress(clock.elapsed / duration, clock.steps)])


def spin_up(flow: FlowRun, turnovers: float, time: Time) -> None:
    """Run the flow for a number of eddy turnovers.

    Raises SceneError if this takes too many steps, for example because a flow without forcing comes to rest.
    """
    history = flow.history
    progress = ProgressLine("spin-up", history.describe, done=history.rows[-1]["turnovers"] / turnovers)

    def until_turned_over(_: np.ndarray, clock: Clock) -> None:
        done = history.rows[-1]["turnovers"] / turnovers
        progress(done, clock.steps)
        if done >= 1:
            clock.stop()
        elif flow.fluid.forcing is None:
            last = history.rows[-1]
            check_span(time, 0.0, (1 - done) * turnovers * last["eddy_turnover_time"], last["time_step"] or np.inf)

    flow.advance([history, until_turned_over])
    flow.phase = "start"
    history.sample(flow.state, flow.clock)
    log.info("spin-up  done  %s", history.describe())


def stationary_span(settings: SpinUp, history: FlowHistory) -> dict[str, float]:
    """Return the start and the end of the time over which statistics are averaged: the last `stationary` turnovers of
    the spin-up."""
    turned, times = (np.array([row[name] for row in history.rows]) for name in ("turnovers", "time"))
    last = int(np.argmax(turned >= settings.turnovers))
    first = int(np.argmax(turned >= turned[last] - settings.stationary))
    return {"start": times[first], "end": times[last]}


def write_final_fields(file: File, flow: FlowRun) -> None:
    """Store the final velocity, and for a compressible fluid the density, on the full grid."""
    grid = flow.fluid.grid
    physical = grid.backward(flow.state)
    variables = {"velocity": physical[:3]}
    if len(physical) == 4:
        variables["density"] = np.exp(physical[3:])
    writer = FieldWriter(file, "final", grid.cells, {name: len(values) for name, values in variables.items()})
    writer.append(flow.clock.time, grid.decomposition.start, variables)


def scales_of(sample: dict[str, float]) -> dict[str, float]:
    """Return the entries of a sample that describe the flow, without the entries that describe the run."""
    return {name: value for name, value in sample.items() if name not in OF_THE_RUN}
