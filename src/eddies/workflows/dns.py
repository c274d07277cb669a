"""Ground truth: direct numerical simulation, spin-up, filter, tracers."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from eddies.clock import Clock, ProgressLine
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.forcing import LinearForcing
from eddies.flow.history import FlowHistory
from eddies.flow.initial_fields import INITIAL_FLOWS, balanced_density, sound_wave_density
from eddies.flow.navier_stokes import FLUIDS, Fluid
from eddies.flow.operators import project
from eddies.import_path import is_path, load
from eddies.io.checkpoint import Checkpoint
from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import File, create_product, open_product, write_attributes, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.scene.sections import SpinUp
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import STEPPERS
from eddies.workflows.ground_truth.flow_run import FlowRun, Guard
from eddies.workflows.ground_truth.frame_segments import FrameSegments
from eddies.workflows.ground_truth.tracer_run import TracerRun

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate the flow of a scene and write ground_truth.h5: statistics, and with tracers their frames and fields.

    Forced turbulence is first brought to a stationary state ([spin_up]). Tracers are released with the forcing off.
    Goes on from the newest checkpoint in the directory, if there is one of the same settings.

    Raises Stopped, after a checkpoint, when `stop` asks for it.
    """
    directory, fingerprint = Path(directory), scene.fingerprint("dns")
    guard = Guard(comm, directory / STAGES["dns"].checkpoints, fingerprint, stop or StopRequest(comm))
    saved = guard.checkpoints.newest()
    flow = build_run(scene, comm, guard, saved)
    with create_product(comm, directory / "ground_truth.h5", "ground_truth", scene.provenance("dns")) as file:
        if saved is None:
            flow.history.sample(flow.state, flow.clock)
        if flow.phase == "spin-up":
            spin_up(scene.spin_up.turnovers, flow)
        if scene.tracers is not None:
            follow_tracers(scene, file, flow, saved if flow.phase == "tracers" else None)
        else:
            run_for(scene.time.duration, flow)
            write_final_fields(file, flow)
            write_attributes(file.create_group("reference"), {
                **scales_of(flow.history.sample(flow.state, flow.clock)), "viscosity": flow.fluid.viscosity,
                "energy_budget_error": flow.history.budget_error})
        write_table(file, "statistics", flow.history.columns())
        write_table(file, "spectra_of_statistics", {"energy": np.array(flow.history.spectra)})
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


def run_for(duration: float, flow: FlowRun) -> None:
    """Run the flow for a time after its start or spin-up."""
    clock, progress = flow.clock, ProgressLine("dns", flow.history.describe)
    if flow.phase == "start":
        clock.end, flow.phase = clock.time + duration, "run"
    start = clock.end - duration
    flow.advance([flow.history, lambda _, clock: progress((clock.time - start) / duration, clock.steps)])


def spin_up(turnovers: float, flow: FlowRun) -> None:
    """Run until the flow has turned over the given number of times."""
    history, progress = flow.history, ProgressLine("spin-up", flow.history.describe)

    def until_turned_over(_: np.ndarray, clock: Clock) -> None:
        done = history.rows[-1]["turnovers"] / turnovers
        progress(done, clock.steps)
        if done >= 1:
            clock.stop()

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
    """Release tracers into the flow, forcing off, and store their frames, the filtered fields and the scales."""
    comm, names = flow.fluid.grid.decomposition.comm, saved.files if saved is not None else ()
    with FrameSegments(comm, flow.guard.checkpoints.path, scene.tracers, flow.fluid.compressible, names) as segments:
        run = TracerRun(scene, flow, segments, saved)
        run.follow()
        segments.assemble(file)
    write_attributes(file.create_group("reference"), {
        **scales_of(run.released), "energy_budget_error": flow.history.budget_error, "viscosity": flow.fluid.viscosity,
        **run.scales()})
    run.frames.write_spectra(file)


def build_fluid(scene: Scene, comm: Comm) -> Fluid:
    """The fluid of a scene on its grid, with its forcing if it has one."""
    flow = scene.flow
    grid = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, flow.cells), flow.precision)
    forcing = None
    if scene.forcing is not None:
        forcing = LinearForcing(grid, scene.forcing.injection_rate, scene.forcing.wavenumber)
    kind = load(flow.fluid) if is_path(flow.fluid) else FLUIDS[flow.fluid]
    return kind(grid, flow.viscosity, flow.sound_speed if flow.compressible else math.inf, forcing)


def build_step_limit(scene: Scene, grid: SpectralGrid) -> CourantLimit | FixedStep:
    """How the step of a scene is chosen: fixed, or by the Courant number, with sound for the explicit stepper only."""
    time = scene.time
    if time.step is not None:
        return FixedStep(time.step)
    explicit_sound = scene.flow.sound_speed if time.stepper == "rk4" and scene.flow.compressible else 0.0
    return CourantLimit(grid, time.courant, time.max_step, explicit_sound)


def initial_state(scene: Scene, fluid: Fluid) -> np.ndarray:
    """The state at time 0: velocity, and for a compressible fluid s = ln(rho / rho_0)."""
    initial, grid = scene.initial, fluid.grid
    if initial.kind == "file":
        return _state_from_file(initial.path, fluid)
    velocity = _own_velocity(scene, grid) if is_path(initial.kind) else INITIAL_FLOWS[initial.kind](
        grid, initial, scene.seed)
    if not fluid.compressible:
        return velocity
    if initial.kind == "sound-wave":
        density = sound_wave_density(grid, initial.amplitude, initial.wavenumber)
    else:
        density = balanced_density(grid, velocity, fluid.sound_speed)
    return np.concatenate([velocity, density[None]])


def _own_velocity(scene: Scene, grid: SpectralGrid) -> np.ndarray:
    """What the user's function of an initial flow returns, its solenoidal part; SceneError where it is no velocity."""
    initial, shape = scene.initial, (3, *grid.spectral_shape)
    velocity = load(initial.kind)(grid, initial, scene.seed)
    if not isinstance(velocity, np.ndarray) or velocity.shape != shape:
        found = f"an array {velocity.shape}" if isinstance(velocity, np.ndarray) else f"a {type(velocity).__name__}"
        raise SceneError(f'[initial] kind = "{initial.kind}": returned {found}; must be the modes (3, kz, ky, kx) = '
                         f"{shape} of the velocity on this rank, such as grid.forward(velocity) gives")
    return project(grid, velocity.astype(grid.complex))


def _state_from_file(path: str, fluid: Fluid) -> np.ndarray:
    grid = fluid.grid
    with open_product(grid.decomposition.comm, path, "ground_truth") as file:
        fields = FieldSeries(file, "final")
        if fields.cells != grid.cells:
            raise SceneError(f"[initial] path = {path}: holds fields of {fields.cells} cells a side, [flow] cells is "
                             f"{grid.cells}; make them equal")
        planes = (grid.decomposition.start, grid.decomposition.stop)
        state = grid.forward(fields.read(-1, "velocity", *planes))
        if fluid.compressible:
            if "density" in fields.variables:
                s = grid.forward(np.log(fields.read(-1, "density", *planes)))
            else:
                s = balanced_density(grid, state, fluid.sound_speed)[None]
            return np.concatenate([state, s])
    # A velocity of a compressible flow, or in single precision, is not solenoidal.
    return project(grid, state)


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
