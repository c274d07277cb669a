"""Ground truth: direct numerical simulation, spin-up, filter, tracers."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from eddies.clock import Clock, ProgressLine
from eddies.flow import initial_fields
from eddies.flow.courant import CourantLimit, FixedStep
from eddies.flow.forcing import LinearForcing
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.operators import project
from eddies.flow.spectral_grid import SpectralGrid
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import create_product, open_product, write_attributes, write_table
from eddies.parallel.slab import SlabDecomposition
from eddies.scene import BOX_LENGTH, Scene, SceneError
from eddies.time_stepping import STEPPERS
from eddies.workflows.tracer_frames import TracerFrames

log = logging.getLogger("eddies")


def run(scene: Scene, comm, directory: str | Path) -> None:
    """Simulate the flow of a scene and write ground_truth.h5: statistics, and with tracers their frames and fields.

    Forced turbulence is first brought to a stationary state ([spin_up]). Tracers are released with the forcing off.
    """
    fluid = build_fluid(scene, comm)
    state = initial_state(scene, fluid)
    step_limit = build_step_limit(scene, fluid.grid)
    history = FlowHistory(fluid)
    clock = Clock()
    provenance = {"scene": scene.to_toml(), "fingerprint": scene.fingerprint("dns")}
    with create_product(comm, Path(directory) / "ground_truth.h5", "ground_truth", provenance) as file:
        history.sample(state, clock)
        stepper = STEPPERS[scene.time.stepper](fluid)
        if scene.spin_up is not None:
            state = spin_up(scene.spin_up.turnovers, state, stepper, step_limit, clock, history)
        if scene.tracers is not None:
            follow_tracers(scene, file, state, stepper, step_limit, clock, history)
        else:
            clock.end = clock.time + scene.time.duration
            start, span = clock.time, scene.time.duration
            progress = ProgressLine("dns", history.describe)
            state = advance(state, stepper, step_limit, clock,
                            [history, lambda _, clock: progress((clock.time - start) / span, clock.steps)])
            write_final_fields(file, fluid.grid, state)
            write_attributes(file.create_group("reference"), {
                **scales_of(history.sample(state, clock)), "energy_budget_error": history.budget_error,
                "viscosity": fluid.viscosity})
        write_table(file, "statistics", history.columns())


def advance(state: np.ndarray, stepper: Callable, step_limit: Callable, clock: Clock,
            observers: Sequence[Callable]) -> np.ndarray:
    """The state when the clock ends; every observer sees every step."""
    while clock.running:
        step = step_limit(state, clock)
        state = stepper(state, step)
        clock.tick(step)
        for observer in observers:
            observer(state, clock)
    return state


def spin_up(turnovers: float, state: np.ndarray, stepper: Callable, step_limit: Callable, clock: Clock,
            history: FlowHistory) -> np.ndarray:
    """Run until the flow has turned over the given number of times."""
    progress = ProgressLine("spin-up", history.describe)

    def until_turned_over(_: np.ndarray, clock: Clock) -> None:
        done = history.rows[-1]["turnovers"] / turnovers
        progress(done, clock.steps)
        if done >= 1:
            clock.stop()

    state = advance(state, stepper, step_limit, clock, [history, until_turned_over])
    history.sample(state, clock)
    log.info("spin-up  done  %s", history.describe())
    return state


def follow_tracers(scene: Scene, file, state: np.ndarray, stepper: Callable, step_limit: Callable, clock: Clock,
                   history: FlowHistory) -> None:
    """Release tracers into the flow, forcing off, and store their frames, the filtered fields and the scales."""
    fluid, settings = history.fluid, scene.tracers
    released = history.sample(state, clock)
    fluid.forcing = None
    field = FilteredField(fluid.grid, settings.width, settings.interpolation)
    columns = release(fluid.grid.decomposition, scene.seed, settings.particles_per_side, settings.placement)
    tracers = TracerParticles(field, columns, state)
    frames = TracerFrames(file, tracers, settings, clock.time, isinstance(fluid, CompressibleFluid))
    intervals = int(np.ceil(settings.turnovers * released["eddy_turnover_time"] / settings.frame_interval - 1e-9))
    progress = ProgressLine("tracers", history.describe)
    frames.store(state, clock)
    first_step = clock.steps
    for interval in range(1, intervals + 1):
        # The longest allowed step that divides the frame interval, so that frames are equally spaced.
        steps = int(np.ceil(settings.frame_interval / step_limit.bound(state, clock) - 1e-9))
        step = settings.frame_interval / max(steps, int(np.ceil(settings.frame_interval / scene.time.max_step - 1e-9)))
        clock.end = clock.time + settings.frame_interval
        state = advance(state, stepper, FixedStep(step), clock,
                        [history, lambda state, _: tracers.advance(state, step)])
        frames.store(state, clock)
        progress(interval / intervals, clock.steps - first_step)
    history.sample(state, clock)
    write_attributes(file.create_group("reference"), {
        **scales_of(released), "energy_budget_error": history.budget_error, "viscosity": fluid.viscosity,
        "released_at": frames.released_at, "sound_speed": scene.flow.sound_speed or np.inf, "length": settings.width,
        "spacing": settings.spacing, **frames.scales()})
    frames.write_spectra()


def build_fluid(scene: Scene, comm) -> IncompressibleFluid | CompressibleFluid:
    """The fluid of a scene on its grid, with its forcing if it has one."""
    flow = scene.flow
    grid = SpectralGrid(SlabDecomposition(comm, BOX_LENGTH, flow.cells), flow.precision)
    forcing = None
    if scene.forcing is not None:
        forcing = LinearForcing(grid, scene.forcing.injection_rate, scene.forcing.wavenumber)
    if flow.fluid == "incompressible":
        return IncompressibleFluid(grid, flow.viscosity, forcing)
    return CompressibleFluid(grid, flow.viscosity, flow.sound_speed, forcing)


def build_step_limit(scene: Scene, grid: SpectralGrid) -> CourantLimit | FixedStep:
    """How the step of a scene is chosen: fixed, or by the Courant number, with sound for the explicit stepper only."""
    time = scene.time
    if time.step is not None:
        return FixedStep(time.step)
    explicit_sound = scene.flow.sound_speed if time.stepper == "rk4" and scene.flow.fluid == "compressible" else 0.0
    return CourantLimit(grid, time.courant, time.max_step, explicit_sound)


def initial_state(scene: Scene, fluid: IncompressibleFluid | CompressibleFluid) -> np.ndarray:
    """The state at time 0: velocity, and for a compressible fluid s = ln(rho / rho_0)."""
    initial, grid = scene.initial, fluid.grid
    if initial.kind == "file":
        return _state_from_file(initial.path, fluid)
    velocities = {
        "random": lambda: initial_fields.random_velocity(grid, scene.seed, initial.amplitude, initial.peak_wavenumber),
        "taylor-green": lambda: initial_fields.taylor_green(grid, initial.amplitude),
        "abc": lambda: initial_fields.abc(grid, initial.amplitude, initial.wavenumber),
        "shear-wave": lambda: initial_fields.shear_wave(grid, initial.amplitude, initial.wavenumber),
        "sound-wave": lambda: np.zeros((3, *grid.spectral_shape), grid.complex),
    }
    velocity = velocities[initial.kind]()
    if isinstance(fluid, IncompressibleFluid):
        return velocity
    if initial.kind == "sound-wave":
        density = initial_fields.sound_wave_density(grid, initial.amplitude, initial.wavenumber)
    else:
        density = initial_fields.balanced_density(grid, velocity, fluid.sound_speed)
    return np.concatenate([velocity, density[None]])


def _state_from_file(path: str, fluid: IncompressibleFluid | CompressibleFluid) -> np.ndarray:
    grid = fluid.grid
    with open_product(grid.decomposition.comm, path, "ground_truth") as file:
        fields = FieldSeries(file, "final")
        if fields.cells != grid.cells:
            raise SceneError(f"[initial] path = {path}: holds fields of {fields.cells} cells a side, [flow] cells is "
                             f"{grid.cells}; make them equal")
        planes = (grid.decomposition.start, grid.decomposition.stop)
        state = grid.forward(fields.read(-1, "velocity", *planes))
        if isinstance(fluid, CompressibleFluid):
            if "density" in fields.variables:
                s = grid.forward(np.log(fields.read(-1, "density", *planes)))
            else:
                s = initial_fields.balanced_density(grid, state, fluid.sound_speed)[None]
            return np.concatenate([state, s])
    # A velocity of a compressible flow, or in single precision, is not solenoidal.
    return project(grid, state)


def write_final_fields(file, grid: SpectralGrid, state: np.ndarray) -> None:
    """Store the last velocity, and density of a compressible fluid, on the full grid."""
    physical = grid.backward(state)
    variables = {"velocity": physical[:3]}
    if len(state) == 4:
        variables["density"] = np.exp(physical[3:])
    writer = FieldWriter(file, "final", grid.cells, {name: len(values) for name, values in variables.items()})
    writer.append(0.0, grid.decomposition.start, variables)


def scales_of(sample: dict[str, float]) -> dict[str, float]:
    """The part of a sample that tells of the flow, not of the run."""
    of_the_run = ("time", "turnovers", "time_step", "seconds_per_step")
    return {name: value for name, value in sample.items() if name not in of_the_run}
