"""Estimates of a scene before it runs: turbulence, steps and frames; memory of a rank, disk space, and usable ranks.

Sizes are in bytes. Their constants were measured with the scenes `tiny` to `hit` on one and two ranks, and with thin
slabs of 1024^3 cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from eddies.clock import Clock, ladder_step, rounded_up
from eddies.cores import threads
from eddies.errors import UserError
from eddies.flow.history import EVERY, FlowHistory
from eddies.flow.initial_fields import SPEEDS
from eddies.flow.navier_stokes import advective_speed
from eddies.flow.statistics import derived_scales
from eddies.io.checkpoint import KEPT
from eddies.io.provenance import product_attributes
from eddies.parallel.communicator import Comm
from eddies.parallel.halo import thick_slabs
from eddies.parallel.reduction import global_max
from eddies.particles.flow_units import planes_for
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Flow, Forcing, Initial, Scene, Tracers
from eddies.scene.sections import NEIGHBORS, RECONSTRUCTED
from eddies.spectral.fourier_passes import BLOCK_BYTES
from eddies.spectral.interpolation import margin_for, spline_ranks
from eddies.time_stepping import ETDRK4
from eddies.workflows.ground_truth.frame_counts import KERNEL_FIELDS, TESTED_PARTICLES, unfiltered_frames, whole_cells
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state
from eddies.workflows.learned.source import ModelDefinition

if TYPE_CHECKING:
    from eddies.workflows.ground_truth.track_frames import TrackFrames  # imports scipy

DISSIPATION_CONSTANT = 0.5   # C_eps = eps L / u'^3 of developed turbulence
PEAK_SPEED = 7.0             # max(|u| + |v| + |w|) divided by u' in turbulence; one component is at most about 4 u'

#: What the files of scenes hold, by [flow] and [initial]: scales of an initial flow and its `peak_speed`, or tracks.
Measured = Mapping[tuple[Flow, Initial], Any]


def measure(scenes: Iterable[Scene], comm: Comm) -> tuple[Measured, list[str]]:
    """Read the files from which the flows or tracks of scenes come; all ranks call it.

    Returns what they hold, and a message for each file that cannot be used. An initial flow is made on the grid of the
    scene, as at the start of the direct simulation.
    """
    found: dict[tuple[Flow, Initial], Any] = {}
    problems = []
    for key, scene in {(each.flow, each.initial): each for each in scenes}.items():
        try:
            if scene.tracks is not None:
                from eddies.workflows.ground_truth.track_frames import TrackFrames  # imports scipy
                found[key] = TrackFrames(comm, scene.tracks)
            elif scene.initial.path is not None:
                fluid = build_fluid(scene.flow, None, comm)
                state = initial_state(scene.initial, scene.seed, fluid)
                speed = float(global_max(comm, advective_speed(fluid.grid, state[:3])))
                found[key] = FlowHistory(fluid).sample(state, Clock()) | {"peak_speed": speed}
        except UserError as error:
            problems.append(str(error))
    return found, problems


# ---- turbulence and steps


@dataclass(frozen=True, kw_only=True)
class Estimates:
    """Expected numbers of a scene; None where they are unknown before a run.

    Parameters
    ----------
    scales : scales of the turbulence that the forcing sustains, or of the initial flow, with the names that they have
        in `reference` of a ground truth; None for a flow without turbulence.
    peak_speed : maximum of |u| + |v| + |w|; None if the flow comes from the user and is not forced.
    rms_speed : rms of the velocity vector; None where `peak_speed` is None, and for a pure sound wave.
    mach : turbulent Mach number; None for a fluid without a sound speed.
    courant_step : longest step of the direct simulation that its Courant number allows.
    step, limited_by : time step of the direct simulation, and the key of [time] that limits it.
    run_time : physical time that the direct simulation covers.
    frames : number of frames of the tracers or tracks, 0 without them.
    steps : number of steps of the direct simulation.
    tracks : the measured tracks.
    """

    scales: Mapping[str, float] | None
    peak_speed: float | None
    rms_speed: float | None
    mach: float | None
    courant_step: float | None
    step: float | None
    limited_by: str
    run_time: float | None
    frames: int | None
    steps: int | None
    tracks: TrackFrames | None


def estimate(scene: Scene, measured: Measured = {}) -> Estimates:
    """Estimate the turbulence, the speeds and the steps of a scene. `measured` is what `measure` has found."""
    flow, time, tracers, known = scene.flow, scene.time, scene.tracers, measured.get((scene.flow, scene.initial))
    tracks = known if scene.tracks is not None else None
    scales, peak, rms = (None, None, None) if scene.tracks is not None else _speeds(scene, known)
    bound = step = None
    if peak is not None:  # sound counts for an explicit stepper only
        speed = peak + (math.sqrt(3) * (flow.sound_speed or 0.0) if time.explicit else 0.0)
        bound = time.courant * BOX_LENGTH / flow.cells / speed if speed > 0 else math.inf
        step, limited_by = ladder_step(time.max_step, bound), "max_step" if bound >= time.max_step else "courant"
    if time.step is not None or bound is None:
        step, limited_by = time.step, "step"
    spin_up, followed = (0.0 if part is None else part.turnovers * scales["eddy_turnover_time"] if scales else None
                         for part in (scene.spin_up, tracers))
    frames = run_time = steps = None
    if scene.tracks is not None:
        frames = tracks and len(tracks.times)
    elif followed is not None:
        frames = max(rounded_up(followed / tracers.frame_interval), 1) + 1 if tracers else 0
    if spin_up is not None and followed is not None:
        alone = spin_up + (time.duration or 0.0)
        run_time = alone + followed
        if step is not None:
            steps = rounded_up(alone / step)
            if tracers:  # each frame interval is divided into equal steps
                longest = min(time.step or bound, time.max_step)
                steps += (frames - 1) * rounded_up(tracers.frame_interval / longest)
    return Estimates(
        scales=scales, peak_speed=peak, rms_speed=rms,
        mach=rms / flow.sound_speed if rms is not None and flow.sound_speed else None, courant_step=bound, step=step,
        limited_by=limited_by, run_time=run_time, frames=frames, steps=steps, tracks=tracks)


def _speeds(scene: Scene, known: Mapping[str, float] | None) -> tuple[
        Mapping[str, float] | None, float | None, float | None]:
    """Return `scales`, `peak_speed` and `rms_speed` of the estimates. `known` holds the scales of the initial flow in a
    file."""
    initial, forcing = scene.initial, scene.forcing
    if known is not None and not (scene.spin_up and forcing and forcing.injection_rate > 0):
        return (known if known["dissipation_rate"] > 0 else None, known["peak_speed"],
                math.sqrt(3) * known["velocity_rms"])
    scales = expected_scales(scene.flow, initial, forcing)
    if scales or initial.flow.turbulent:
        speed = scales["velocity_rms"] if scales else initial.amplitude
        return scales, PEAK_SPEED * speed, math.sqrt(3) * speed
    if initial.flow.sound:
        return None, initial.amplitude * scene.flow.sound_speed, None
    rms, peak = (each and each * initial.amplitude for each in SPEEDS.get(initial.kind, (None, None)))
    return None, peak, rms


def expected_scales(flow: Flow, initial: Initial, forcing: Forcing | None) -> dict[str, float] | None:
    """Return the scales of the turbulence that the forcing sustains, or that decays from a random start; None for other
    flows.

    The integral scale is sqrt(2 pi) / k, where k is the wavenumber of the forcing or the initial peak of the spectrum.
    This is exact for the initial spectrum and holds within about 10 % for forced turbulence. The dissipation rate is
    C_eps u'^3 / L.
    """
    if forcing and forcing.injection_rate > 0:
        scale, rate = math.sqrt(2 * math.pi) / forcing.wavenumber, forcing.injection_rate
        speed = (rate * scale / DISSIPATION_CONSTANT) ** (1 / 3)
    elif initial.flow.turbulent:
        scale, speed = math.sqrt(2 * math.pi) / initial.peak_wavenumber, initial.amplitude
        rate = DISSIPATION_CONSTANT * speed**3 / scale
    else:
        return None
    found = {"dissipation_rate": rate, **derived_scales(speed, scale, rate, flow.viscosity, flow.largest_wavenumber)}
    return found if flow.viscosity > 0 else None


# ---- memory and disk


# Memory of a process that holds no field, without and with torch.
FLOW_PROCESS, TORCH_PROCESS = 100e6, 285e6
# Direct simulation of a compressible (True) or incompressible (False) fluid: bytes of a cell in float64, and number of
# work arrays of at least two planes. Bytes of a tracer.
CELL_BYTES, BLOCK_ARRAYS, TRACER_BYTES = {True: 320, False: 220}, {True: 64, False: 32}, 300
# Bytes in the evaluation of a model: per particle, per grid point, and per neighbour in the neighbour lists. Bytes in
# the training of the kernel: per neighbour of a grid point, and per particle in the table of a field.
PARTICLE_BYTES, POINT_BYTES, NEIGHBOR_BYTES, GRADIENT_BYTES, TABLE_BYTES = 800, 160, 8, 200, 1100
ROW_BYTES = 300              # of a row of measured tracks; rank 0 holds all of them
# Bytes on disk: of a product without its frames, and of a row of the statistics without the spectrum; of a particle in
# a frame of a ground truth (position, velocity, images of the box), and in one of a rollout, in single precision
# (acceleration, too).
PRODUCT_BYTES, SAMPLE_BYTES, FRAME_BYTES, ROLLOUT_BYTES = 45_000, 200, 54, 42


class Storage(NamedTuple):
    """Bytes that a stage needs: memory of the rank that needs the most, and disk space of the stage.

    `kept` is the disk space of the files that the stage leaves in the run directory, None if unknown. `scratch` is that
    of the files that it removes at its end.
    """

    memory: float
    kept: float | None
    scratch: float = 0.0


def storage(scene: Scene, stage: str, ranks: int, measured: Measured = {}) -> Storage:
    """Estimate the memory and the disk space that a stage needs. `measured` is what `measure` has found."""
    tracers, kernel, model, simulation = scene.tracers, scene.kernel, scene.model, scene.simulation
    expected = estimate(scene, measured)
    if stage == "dns" and scene.tracks is None:
        return Storage(flow_memory(scene.flow, tracers, ranks), *flow_disk(scene, expected))
    if stage == "train-kernel":  # planes of five reconstructions, velocity and gradient
        points = tracers.cells**3 / ranks
        lists = KERNEL_FIELDS * NEIGHBOR_BYTES * points + GRADIENT_BYTES * min(kernel.points, points)
        memory = KERNEL_FIELDS * TABLE_BYTES * tracers.particles / ranks + lists * kernel.neighbors
        return Storage(TORCH_PROCESS + memory, PRODUCT_BYTES + 80 * tracers.cells**2 + 64 * kernel.steps)
    if stage in ("dns", "reconstruct"):
        tracks, resolved, settings = expected.tracks, tracers, scene.reconstruction
        if settings is not None:
            resolved = settings.resolving(tracers, (scene.tracks or tracers).filtered)
        memory = TORCH_PROCESS + evaluation_memory(
            tracks.mean_count if tracks else tracers.particles, planes_for(resolved.particles), ranks)
        if stage == "reconstruct" and settings.method == "memory":  # the modes of each sample
            memory += settings.samples * 24 * planes_for(resolved.particles)**3 / ranks
        memory += ROW_BYTES * tracks.mean_count * len(tracks.times) if tracks else 0.0
        return Storage(memory, tracks_disk(scene, tracks) if stage == "dns" else fields_disk(scene, expected.frames))
    planes = planes_for(tracers.particles)
    memory = evaluation_memory(tracers.particles, planes if resolves_velocity(scene) or stage != "train" else 0, ranks)
    if model and "pairs" in model.reads:
        definition, reach = ModelDefinition.of(scene), 1 + (simulation.skin if simulation else 0.0)
        ghosts = tracers.particles * definition.radius * reach / math.pi if ranks > 1 else 0.0
        memory += PARTICLE_BYTES * ghosts
        memory += NEIGHBOR_BYTES * definition.neighbors * reach**3 * tracers.particles / ranks
    if stage == "train":         # samples of rates, and the history
        training = scene.own_training
        if scene.training and scene.training.field_weight > 0:
            memory += NEIGHBOR_BYTES * kernel.neighbors * tracers.particles / ranks
        evaluations = training.frames + 2 if training else 1  # each has neighbour lists and a grid
        samples = 48 * min(tracers.particles, TESTED_PARTICLES)
        return Storage(TORCH_PROCESS + evaluations * memory,
                       PRODUCT_BYTES + samples + 100 * (training.steps_in_all if training else 0))
    memory += TORCH_PROCESS + (CELL_BYTES[True] * planes**3 / ranks if scene.coarse_cells else 0.0)
    if stage == "find-step":
        return Storage(memory, PRODUCT_BYTES)
    time = expected.scales and simulation.turnovers * expected.scales["eddy_turnover_time"]
    return Storage(memory, time and rollout_bytes(tracers.particles, rounded_up(time / simulation.frame_interval) + 1))


def forces_rollout(scene: Scene) -> bool:
    """Return whether particles of the rollout are forced."""
    injection = scene.simulation.injection if scene.simulation else "none"
    return bool(scene.tracers and scene.tracers.forced) if injection == "truth" else injection != "none"


def resolves_velocity(scene: Scene) -> bool:
    """Return whether the velocity of tracers or of particles of the rollout must be resolved on a grid, because terms
    of the model read it or particles are forced."""
    return bool(scene.model and "resolved" in scene.model.reads or scene.tracers and scene.tracers.forced
                or forces_rollout(scene))


def flow_memory(flow: Flow, tracers: Tracers | None, ranks: int) -> float:
    """Return the memory of a rank in the direct simulation."""
    cells, real = flow.cells, flow.real_bytes
    block = BLOCK_ARRAYS[flow.compressible] * max(threads() * BLOCK_BYTES, 2 * cells**2 * real)
    points = cells**2 * math.ceil(cells / ranks)
    size = FLOW_PROCESS + CELL_BYTES[flow.compressible] * real / 8 * points + block
    sets = tracers.all if tracers else ()
    return size + sum(3 * real * points + TRACER_BYTES * each.particles / ranks for each in sets)


def evaluation_memory(particles: float, planes: int, ranks: int) -> float:
    """Return the memory of a rank in an evaluation of the model, without neighbours.

    `planes` is the number of planes of the grid of the resolved velocity, 0 for a model without this grid.
    """
    return PARTICLE_BYTES * particles / ranks + POINT_BYTES * planes**2 * math.ceil(planes / ranks)


def flow_disk(scene: Scene, expected: Estimates) -> tuple[float | None, float]:
    """Return `kept` and `scratch` of the direct simulation (see `Storage`)."""
    flow, tracers, frames = scene.flow, scene.tracers, expected.frames or 0
    k_max = flow.largest_wavenumber
    statistics = (SAMPLE_BYTES + 8 * (math.ceil(math.sqrt(3) * k_max) + 1)) * ((expected.steps or 0) // EVERY)
    state = flow.components * (2 * k_max + 1) ** 2 * (k_max + 1) * 2 * flow.real_bytes
    checkpoints = KEPT * state    # KEPT + 1 exist while one is written; one stays, as `state`
    if tracers is None:
        return state + statistics + 4 * flow.components * flow.cells**3, checkpoints
    size = trajectory_bytes(
        flow, tracers, frames, len(unfiltered_frames(scene.simulation, scene.training, tracers.field_every, frames)))
    kept, scratch = statistics + size, checkpoints + size  # the frames are in segments until the end
    if tracers.sets:  # each set has the statistics; the run directory has the final fields and no last state
        kept += len(tracers.sets) * statistics + 4 * flow.components * flow.cells**3
        state = 0
    return None if expected.frames is None else state + kept, scratch


def trajectory_bytes(flow: Flow, tracers: Tracers, frames: int, whole: int) -> int:
    """Return the size of the frames of tracers, of the filtered fields, and of the unfiltered states. `whole` is the
    number of unfiltered states."""
    size = 0
    for each in tracers.all:
        points = (each.cells**3 * math.ceil(frames / each.field_every)
                  + whole_cells(flow.largest_wavenumber) ** 3 * whole)
        size += frames * each.particles * (FRAME_BYTES + 8 * flow.compressible) + 4 * flow.components * points
    return size


def tracks_disk(scene: Scene, tracks: TrackFrames | None) -> float | None:
    """Return the disk space of the ground truth of measured tracks: filtered fields, and frames of the particles of
    models or, without models, of the tracks that are present in all frames."""
    if tracks is None:
        return None
    tracers, learned, frames = scene.tracers, any((scene.kernel, scene.model, scene.simulation)), len(tracks.times)
    particles = (tracers.particles if learned else tracks.complete) * frames
    return (PRODUCT_BYTES + particles * (FRAME_BYTES + 8 * scene.flow.compressible)
            + 12 * tracers.cells**3 * math.ceil(frames / tracers.field_every))


def fields_disk(scene: Scene, frames: int | None) -> float | None:
    """Return the disk space of reconstructed fields."""
    settings = scene.reconstruction
    values = sum(RECONSTRUCTED[name] for name in (*settings.fields, *settings.deviations))
    values *= (settings.cells or scene.tracers.cells) ** 3
    return frames and PRODUCT_BYTES + 4 * values * math.ceil(frames / settings.every)


def rollout_bytes(particles: int, frames: int) -> int:
    """Return the size of the frames of a rollout."""
    return ROLLOUT_BYTES * particles * frames


def most_disk(work: Iterable[Storage]) -> float:
    """Return the most disk space that stages need at any moment, if they run one after the other."""
    left = most = 0.0
    for needed in work:
        left += needed.kept or 0.0
        most = max(most, left + needed.scratch)
    return most


def in_units(size: float) -> str:
    """Return a number of bytes as text, such as "1.2 GB"."""
    unit, name = next(((unit, name) for unit, name in ((1e9, "GB"), (1e6, "MB")) if size >= unit), (1e3, "kB"))
    return f"{size / unit:.3g} {name}" if name == "GB" else f"{size / unit:.0f} {name}"


# ---- ranks


def most_ranks(scene: Scene, measured: Measured = {}) -> dict[str, int]:
    """Return the largest number of ranks that each part of a run accepts, by the name of the limit. A limit of a
    variant is included if it is below all limits of the scene. `measured` is what `measure` has found."""
    limits: dict[str, int] = {}
    for reason, ranks in _limits(scene, measured):
        limits[reason] = min(ranks, limits.get(reason, ranks))
    fewest = min(limits.values())
    return limits | {f"variant {name}: {reason}": ranks for name, variant in scene.variant.items()
                     for reason, ranks in most_ranks(variant, measured).items() if ranks < fewest}


def _limits(scene: Scene, measured: Measured) -> Iterator[tuple[str, int]]:
    tracers, simulation, reconstruction = scene.tracers, scene.simulation, scene.reconstruction
    yield "a grid plane for each rank", scene.flow.cells
    if tracers is None:
        return
    yield f"ghost planes of the {tracers.interpolation} splines", spline_ranks(scene.flow.cells, tracers.interpolation)
    if scene.kernel:
        support = tracers.radius_of(scene.kernel.neighbors)
        yield (f"slabs of the fields, at least as thick as the kernel's support {support:.3g}",
               thick_slabs(tracers.cells, BOX_LENGTH, support))
    if reconstruction is not None:
        yield _of_the_grid(tracers, 0.0)
        if reconstruction.of_neighbors:
            yield _of_the_reach(tracers, tracers.radius_of(scene.kernel.neighbors if scene.kernel else NEIGHBORS))
    if "train" in scene.stages:
        # The a-priori test interpolates filtered fields to the particles.
        yield "ghost planes of the filtered fields", spline_ranks(tracers.cells, "quintic")
        training = scene.own_training
        yield from _of_training(scene, tracers)
        for name, path in zip(training.truths or (), training.truth_files) if training else ():
            found, forced = product_attributes(path, "reference"), bool(product_attributes(path, "forcing"))
            if "spacing" in found:  # there may be another number of particles
                other = tracers.with_count(round((BOX_LENGTH / found["spacing"]) ** 3))
                for reason, ranks in _of_training(scene, other, forced):
                    yield f"[training] truths: {quoted(name)}: {reason}", ranks
    if scene.coarse_cells:
        # In one step a particle crosses at most as many cells as the Courant number.
        margin = math.ceil(max(scene.time.courant, ETDRK4.most_courant * simulation.finds_step))
        yield "ghost planes of the coarse grid", spline_ranks(scene.coarse_cells, tracers.interpolation, margin)
        if scene.eulerian and scene.eulerian.start == "particles":
            yield _of_the_grid(tracers, 0.0)
    elif simulation is not None:
        reads = {*simulation.form.needs, *(scene.model.reads if "model" in simulation.form.needs else ())}
        radius = ModelDefinition.of(scene).radius
        skin = simulation.skin * radius
        if "pairs" in reads:
            yield _of_the_reach(tracers, radius + skin)
        if "resolved" in reads or forces_rollout(scene):
            yield _of_the_grid(tracers, skin / 2)


def _of_training(scene: Scene, tracers: Tracers, forced: bool = False) -> Iterator[tuple[str, int]]:
    """Yield the limits of the training on a ground truth with such tracers."""
    horizons = scene.own_training and scene.own_training.horizons
    if "pairs" in scene.model.reads:
        yield _of_the_reach(tracers, tracers.radius_of(ModelDefinition.of(scene).neighbors))
    if resolves_velocity(scene) or forced or horizons and horizons.energy_weight > 0:
        yield _of_the_grid(tracers, 0.0)


def _of_the_reach(tracers: Tracers, reach: float) -> tuple[str, int]:
    """Return the limit of particles that interact within the range `reach`."""
    return (f"slabs, at least as thick as the particles' reach {reach:.3g}",
            thick_slabs(planes_for(tracers.particles), BOX_LENGTH, reach))


def _of_the_grid(tracers: Tracers, outside: float) -> tuple[str, int]:
    """Return the limit of the grid of the resolved velocity, if particles leave their slab by the distance `outside`
    (`ResolvedVelocity.on_slabs`)."""
    planes = planes_for(tracers.particles)
    return ("ghost planes of the resolved velocity",
            spline_ranks(planes, "cubic", margin_for(outside, BOX_LENGTH / planes)))
