"""Ground truth: direct numerical simulation, spin-up, filter, tracers."""

from __future__ import annotations

import logging
from dataclasses import asdict
from pathlib import Path

import numpy as np

from eddies.clock import Clock, ProgressLine
from eddies.flow.history import FlowHistory
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.fields import FieldWriter
from eddies.io.frame_segments import FrameSegments
from eddies.io.hdf5 import File, create_product, write_attributes, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.scene.sections import SpinUp
from eddies.time_stepping import STEPPERS
from eddies.workflows.ground_truth.flow_run import FlowRun, TracerRun
from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
from eddies.workflows.ground_truth.tracer_frames import frame_layout
from eddies.workflows.problems import check_span
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate the flow of a scene and write ground_truth.h5: statistics, and with tracers their frames and fields.

    Forced turbulence is first brought to a stationary state ([spin_up]). Tracers are released with the forcing off,
    unless [tracers] forced.
    Goes on from the newest checkpoint in the directory, if there is one of the same settings.

    Raises Stopped, after a checkpoint, when `stop` asks for it.
    """
    directory, fingerprint = Path(directory), stage_fingerprint(scene, "dns")
    guard = Guard(comm, directory / STAGES["dns"].checkpoints, fingerprint, stop)
    saved = guard.checkpoints.newest()
    flow = build_run(scene, comm, guard, saved)
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", stage_provenance(scene, "dns")) as file:
        if saved is None:
            flow.history.sample(flow.state, flow.clock)
        if flow.phase == "spin-up":
            spin_up(scene, flow)
        if scene.tracers is not None:
            follow_tracers(scene, file, flow, saved if flow.phase == "tracers" else None)
        else:
            run_for(scene, flow)
            write_final_fields(file, flow)
            write_attributes(file.create_group("reference"), {
                **scales_of(flow.history.sample(flow.state, flow.clock)), "viscosity": flow.fluid.viscosity,
                "energy_budget_error": flow.history.budget_error})
        write_table(file, "statistics", flow.history.columns())
        energy = np.array(flow.history.spectra)
        write_table(file, "spectra_of_statistics", {"wavenumber": np.arange(energy.shape[1]), "energy": energy})
        if scene.spin_up is not None and scene.spin_up.stationary is not None:
            write_attributes(file.create_group("stationary"), stationary_span(scene.spin_up, flow.history))
    guard.checkpoints.remove()


def build_run(scene: Scene, comm: Comm, guard: Guard, saved: Checkpoint | None) -> FlowRun:
    """The flow of a scene at time 0, or as a checkpoint holds it."""
    fluid = build_fluid(scene, comm)
    state = initial_state(scene, fluid) if saved is None else None
    flow = FlowRun(fluid, state, STEPPERS[scene.time.stepper](fluid), build_step_limit(scene, fluid.grid),
                   FlowHistory(fluid), guard, phase="start" if scene.spin_up is None else "spin-up")
    if saved is not None:
        flow.load_state_dict(saved)
        log.info("dns: goes on from step %d, time %.4g", flow.clock.steps, flow.clock.time)
    return flow


def run_for(scene: Scene, flow: FlowRun) -> None:
    """Run the flow for [time] duration after its start or spin-up.

    Raises SceneError where that takes too many steps.
    """
    clock, duration = flow.clock, scene.time.duration
    if flow.phase == "start":
        check_span(scene, duration, flow.step_limit.bound(flow.state, clock))
        clock.end, flow.phase = clock.time + duration, "run"
    start = clock.end - duration
    progress = ProgressLine("dns", flow.history.describe, done=(clock.time - start) / duration)
    flow.advance([flow.history, lambda _, clock: progress((clock.time - start) / duration, clock.steps)])


def spin_up(scene: Scene, flow: FlowRun) -> None:
    """Run until the flow has turned over as often as [spin_up] asks. Raises SceneError where that takes too many steps,
    as in a flow that nothing forces and that comes to rest meanwhile."""
    history, turnovers = flow.history, scene.spin_up.turnovers
    progress = ProgressLine("spin-up", history.describe, done=history.rows[-1]["turnovers"] / turnovers)

    def until_turned_over(_: np.ndarray, clock: Clock) -> None:
        done = history.rows[-1]["turnovers"] / turnovers
        progress(done, clock.steps)
        if done >= 1:
            clock.stop()
        elif flow.fluid.forcing is None:
            last = history.rows[-1]
            check_span(scene, (1 - done) * turnovers * last["eddy_turnover_time"], last["time_step"] or np.inf)

    flow.advance([history, until_turned_over])
    flow.clock.end, flow.phase = np.inf, "start"  # the end is known in the phases that follow
    history.sample(flow.state, flow.clock)
    log.info("spin-up  done  %s", history.describe())


def stationary_span(settings: SpinUp, history: FlowHistory) -> dict[str, float]:
    """First and last time of the turnovers at the end of the spin-up that count as stationary."""
    turned, times = (np.array([row[name] for row in history.rows]) for name in ("turnovers", "time"))
    last = int(np.argmax(turned >= settings.turnovers))
    first = int(np.argmax(turned >= turned[last] - settings.stationary))
    return {"start": times[first], "end": times[last]}


def follow_tracers(scene: Scene, file: File, flow: FlowRun, saved: Checkpoint | None) -> None:
    """Release tracers into the flow, and store their frames, the filtered fields, the scales, and the forcing that
    stays on."""
    comm, names = flow.fluid.grid.decomposition.comm, saved.files if saved is not None else ()
    if saved is None:
        span = scene.tracers.turnovers * flow.history.sample(flow.state, flow.clock)["eddy_turnover_time"]
        check_span(scene, span, flow.step_limit.bound(flow.state, flow.clock), frames=True)
    layout = frame_layout(scene.tracers, flow.fluid.compressible, flow.fluid.grid.cutoff)
    with FrameSegments(comm, flow.guard.checkpoints.path, layout, names) as segments:
        run = TracerRun(scene, flow, segments, saved)
        run.follow()
        segments.assemble(file)
    write_attributes(file.create_group("reference"), {
        **scales_of(run.released), "energy_budget_error": flow.history.budget_error, "viscosity": flow.fluid.viscosity,
        **run.scales()})
    if flow.fluid.forcing is not None:
        write_attributes(file.create_group("forcing"), asdict(scene.forcing))
    run.frames.write_spectra(file)


def write_final_fields(file: File, flow: FlowRun) -> None:
    """Store the last velocity, and density of a compressible fluid, on the full grid."""
    grid = flow.fluid.grid
    physical = grid.backward(flow.state)
    variables = {"velocity": physical[:3]}
    if len(physical) == 4:
        variables["density"] = np.exp(physical[3:])
    writer = FieldWriter(file, "final", grid.cells, {name: len(values) for name, values in variables.items()})
    writer.append(flow.clock.time, grid.decomposition.start, variables)


def scales_of(sample: dict[str, float]) -> dict[str, float]:
    """The part of a sample that tells of the flow, not of the run."""
    of_the_run = ("time", "turnovers", "time_step", "seconds_per_step")
    return {name: value for name, value in sample.items() if name not in of_the_run}
