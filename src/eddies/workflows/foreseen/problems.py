"""What may go wrong with a scene, a line each: warnings, of key, value, reason and remedy, which a stage logs when it
starts; and refusals, which end a stage on these ranks of this machine."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

from eddies.errors import UserError
from eddies.flow.stability import REMEDIES, limits_of_step
from eddies.io.new_files import LARGEST_BYTES, REMEDY, has_single_writer
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm, node_ranks
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.scene.terms import StepUnits
from eddies.workflows.foreseen.numbers import (courant_bound, expected_allowed_step, expected_turbulence,
                                               largest_wavenumber, peak_speed, rms_speed)
from eddies.workflows.foreseen.ranks import most_ranks
from eddies.workflows.foreseen.storage import disk, in_units, memory, most_disk
from eddies.workflows.ground_truth.scene_flow import stored_states

LARGEST_MACH = 0.3           # turbulent Mach number up to which density fluctuations, of about its square, are small
LEAST_REYNOLDS = 5.0         # Re_lambda from which on there is an inertial transfer from scale to scale
KMAX_ETA = 1.0, 4.0          # that resolves the dissipation, and more than anybody needs


# ---- warnings


def stage_warnings(scene: Scene, stages: Iterable[str]) -> Iterator[str]:
    """The warnings that concern some of the stages that a scene has, a line each."""
    for stage in stages:
        for subject in SUBJECTS.get(stage, ()):
            yield from subject(scene)


def warnings(scene: Scene, ranks: int) -> Iterator[str]:
    """Those of all stages, and of the number of ranks."""
    yield from stage_warnings(scene, scene.stages)
    most = min(most_ranks(scene).values())
    if ranks > most:
        yield f"this job has {ranks} ranks, and the scene can use at most {most}: start fewer"


def resolution(scene: Scene) -> Iterator[str]:
    """Grids too coarse for the dissipation, or much finer than it needs."""
    turbulence, k_max, (least, most) = expected_turbulence(scene), largest_wavenumber(scene), KMAX_ETA
    if turbulence is None:
        return
    reached = k_max * turbulence.kolmogorov_length
    viscosity = (least / k_max) ** (4 / 3) * turbulence.dissipation_rate ** (1 / 3)
    cells = math.ceil(3 * least / turbulence.kolmogorov_length) + 1
    if reached < least * (1 - 1e-3):
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, below {least:g}, so that the "
               f"dissipation is not resolved; raise cells to {cells}, or viscosity to {at_least(viscosity)}")
    elif reached > most:
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, and 1 to 2 resolve the "
               f"dissipation: a step costs {(reached / 2)**3:.0f} times what it could; lower cells to {2 * cells}, or "
               f"viscosity to {viscosity * 2**(4 / 3):.2g}")


def compressibility(scene: Scene) -> Iterator[str]:
    """Sound too slow for what flows."""
    speed, sound = rms_speed(scene), scene.flow.sound_speed
    if speed is None or sound is None or speed <= LARGEST_MACH * sound:
        return
    remedy = f"raise sound_speed to {at_least(speed / LARGEST_MACH)} or more"
    if speed > sound:
        yield (f"[flow] sound_speed = {sound:g}: the flow is supersonic, with a turbulent Mach number of about "
               f"{speed / sound:.2g}: shocks come, which nothing here resolves; {remedy}")
    else:
        yield (f"[flow] sound_speed = {sound:g}: the turbulent Mach number is about {speed / sound:.2g}, above "
               f"{LARGEST_MACH:g}: fluid, balanced start and models take the density for nearly uniform and know no "
               f"shocks; {remedy}")


def turbulence_at_all(scene: Scene) -> Iterator[str]:
    """Viscosity that leaves no turbulence."""
    turbulence = expected_turbulence(scene)
    if turbulence is None or turbulence.reynolds_lambda >= LEAST_REYNOLDS:
        return
    reached = turbulence.reynolds_lambda
    why = ("nothing is turbulent: viscosity stops an eddy before it turns over" if reached < 1 else
           f"below {LEAST_REYNOLDS:g} eddies decay where they are made, without smaller ones")
    yield (f"[flow] viscosity = {scene.flow.viscosity:g}: Re_lambda is about {reached:.2g}, {why}; lower viscosity to "
           f"{at_most(scene.flow.viscosity * (reached / LEAST_REYNOLDS)**2)} or less")


def stability(scene: Scene) -> Iterator[str]:
    """Steps of the direct simulation beyond what its stepper can take."""
    settings, bound = scene.time, courant_bound(scene)
    step = settings.step or min(bound or 0.0, settings.max_step)
    limits = limits_of_step(largest_wavenumber(scene), step, peak_speed(scene) or 0.0, scene.flow.viscosity,
                            settings.explicit, scene.flow.sound_speed)
    for limit in limits:
        if limit.exceeded:
            key = "step" if settings.step else "max_step" if limit.name == "viscosity" else "courant"
            yield f"[time] {key} = {getattr(settings, key):g}: is unstable by {limit}; {REMEDIES[limit.name]}"


def filter_width(scene: Scene) -> Iterator[str]:
    """Filters that filter nothing, or leave nothing."""
    if scene.tracers is None:
        return
    width, forcing = scene.tracers.filter_width, scene.forcing
    if width < BOX_LENGTH / scene.flow.cells:
        yield (f"[tracers] filter_width = {width:.3g}: the filter is narrower than a cell of the grid, it filters "
               f"nothing; raise it to {at_least(BOX_LENGTH / scene.flow.cells)} or more, or lower [tracers] "
               "particles_per_side")
    if forcing is None and not scene.initial.flow.turbulent:
        return
    highest, holds = ((forcing.wavenumber, "that are forced") if forcing else
                      (scene.initial.peak_wavenumber, "that hold the energy"))
    if math.pi / width < highest * (1 - 1e-9):
        yield (f"[tracers] filter_width = {width:.3g}: passes wavenumbers up to {math.pi / width:.2g}, less than the "
               f"{highest:g} of the scales {holds}, so that little of the flow is left; lower it to "
               f"{at_most(math.pi / highest)} or less, or raise particles_per_side")


def learning(scene: Scene) -> Iterator[str]:
    """Weights that are not there, and terms that nothing trains."""
    model = scene.model
    if model.path and not model.weights_file.is_file():
        yield f'[model] path = "{model.path}": there is no {model.weights_file} yet, which `eddies train` will want'
    if scene.training and model.path is None and scene.training.horizons is None:
        for name, settings in model.settings.items():
            if settings.learns_through_horizons:
                yield (f'[model] terms: "{name}" is trained through horizons alone, and stays as it starts without '
                       "them: add [training.horizons]")


def rollout_steps(scene: Scene) -> Iterator[str]:
    """Steps of particles that forcing keeps too fast for them."""
    settings = scene.simulation
    if "model" not in settings.needs or not scene.injects:
        return
    allowed = expected_allowed_step(scene)
    if allowed and math.isfinite(settings.longest_step) and settings.longest_step > allowed * (1 + 1e-9):
        yield (f"[simulation] step = {settings.step:g}: the particles will take shorter steps, of about "
               f"{at_most(allowed)}, in which their resolved velocity can follow the flow; lower it to that")


def term_steps(scene: Scene) -> Iterator[str]:
    """Steps that are too long for terms: in which sound outruns particles, or they relax too far."""
    settings, speed = scene.simulation, rms_speed(scene)
    if "model" not in settings.needs or math.isinf(settings.longest_step):
        return
    units = StepUnits(radius=scene.interaction_radius, filter_width=scene.tracers.filter_width,
                      sound_speed=scene.flow.sound_speed, scheme=settings.scheme,
                      velocity=None if speed is None else speed / math.sqrt(3))
    for name, term in scene.model.settings.items():
        longest = term.longest_step(units)
        if settings.longest_step > longest:
            yield f"[simulation] step = {settings.step:g}: " + term.too_long.format(
                name=name, longest=at_most(longest), integrator=settings.scheme.name)


def beyond_truth(scene: Scene) -> Iterator[str]:
    """A rollout that goes on after the end of its ground truth. Not of a flow that is forced throughout, with whose
    average later frames are compared."""
    settings, tracers, start = scene.simulation, scene.tracers, scene.simulation.start
    if start is None:
        start = scene.seen_in(scene.directory)
    left = (1 - (0.0 if scene.realisations else start)) * tracers.turnovers  # realisations start at the beginning
    if settings.turnovers > left * (1 + 1e-9) and not tracers.forced:
        yield (f"[simulation] turnovers = {settings.turnovers:g}: the ground truth ends {left:.3g} turnovers after its "
               f"start, and what comes later is compared with nothing; lower it to {at_most(left)}, or raise [tracers] "
               f"turnovers to {at_least(tracers.turnovers * settings.turnovers / left)}")


def at_least(value: float) -> str:
    """Two digits, rounded up."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.ceil(value / digit - 1e-9) * digit:.2g}"


def at_most(value: float) -> str:
    """Two digits, rounded down."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{math.floor(value / digit + 1e-9) * digit:.2g}"


SUBJECTS: dict[str, tuple[Callable[[Scene], Iterator[str]], ...]] = {
    "dns": (resolution, compressibility, turbulence_at_all, stability, filter_width),
    "train": (learning,), "simulate": (rollout_steps, term_steps, beyond_truth)}


# ---- refusals


def refusals(scene: Scene, comm: Comm) -> list[str]:
    """What ends a stage of the scene on these ranks; all ranks call it and get the same."""
    return [*files(scene, comm), *forced_modes(scene), *single_writer(scene.stages, scene, comm),
            *small_machine(scene, comm)]


def files(scene: Scene, comm: Comm) -> Iterator[str]:
    """A file to start from, trained weights that are there, and ground truths to train on, that do not fit."""
    model, training = scene.model, scene.training
    try:
        if scene.initial.flow.from_file:
            with stored_states(scene.initial, comm):
                pass
    except UserError as error:
        yield str(error)
    try:
        if model is not None and model.path is not None and on_first_rank(comm, model.weights_file.is_file):
            from eddies.workflows.learned.source import read_source  # torch, where there is a model
            read_source(scene, comm)
    except UserError as error:
        yield str(error)
    if training is not None and training.truths is not None:
        from eddies.workflows.learned.truths import truth_problems  # torch, where there is a model
        yield from truth_problems(scene, comm, scene.directory)


def forced_modes(scene: Scene) -> Iterator[str]:
    """A start without energy at the modes that linear forcing amplifies."""
    initial, forcing = scene.initial, scene.forcing
    if forcing is None or forcing.injection_rate == 0:
        return
    wave = initial.flow.wave and initial.flow.wave * initial.wavenumber
    if initial.flow.sound or wave and wave >= forcing.wavenumber:
        yield (f'[forcing] wavenumber = {forcing.wavenumber:g}: [initial] kind = "{initial.kind}" has no energy at '
               "0 < |k| < wavenumber, which linear forcing could amplify; start from another flow, raise wavenumber, "
               "or remove [forcing]")


def single_writer(stages: Sequence[str], scene: Scene, comm: Comm) -> Iterator[str]:
    """Products that are too large for rank 0 to write for all."""
    for stage in stages if has_single_writer(comm) else ():
        size = disk(scene, stage) or 0.0
        if size > LARGEST_BYTES and STAGES[stage].product is not None:
            yield (f"{STAGES[stage].file}: this h5py is built without MPI, so that rank 0 writes for {comm.size} "
                   f"ranks, up to {in_units(LARGEST_BYTES)} a file, and this will take {in_units(size)}; {REMEDY}")


def small_machine(scene: Scene, comm: Comm) -> Iterator[str]:
    """More memory than the ranks of this node have together, or more disk than is free where run directories are,
    unless --output says otherwise."""
    ranks, there = node_ranks(comm), os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for stage in scene.stages:
        if ranks * (size := memory(scene, stage, comm.size)) > there:
            yield (f"{stage}: {ranks} ranks with about {in_units(size)} each need more than the {in_units(there)} of "
                   "memory here; take more nodes, or fewer cells or particles")
    place = Path("runs") if Path("runs").is_dir() else Path()
    needed, free = most_disk(scene), on_first_rank(comm, lambda: shutil.disk_usage(place).free)
    if needed > free:
        yield (f"the stages need about {in_units(needed)} of disk, and {in_units(free)} are free here; choose another "
               "--output, or raise [tracers] frame_interval or field_every")
