"""Problems of a scene on a machine and in a run directory, which are known before any work. Each text names a key, its
value, the reason and the remedy."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from eddies.errors import UserError
from eddies.flow.stability import REMEDIES, limits_of_step
from eddies.io.hdf5 import open_product
from eddies.io.new_files import LARGEST_BYTES, REMEDY, has_single_writer
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm, node_ranks
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import ScaleError
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.scene.terms import StepUnits
from eddies.workflows.foreseen.numbers import (courant_bound, expected_allowed_step, expected_step, expected_turbulence,
                                               largest_wavenumber, peak_speed, rms_speed, run_time)
from eddies.workflows.foreseen.ranks import rank_problems
from eddies.workflows.foreseen.storage import disk, in_units, memory, most_disk
from eddies.workflows.ground_truth.frame_counts import check_frames
from eddies.workflows.ground_truth.scene_flow import stored_states
from eddies.workflows.variants import Step, steps

LARGEST_MACH = 0.3           # turbulent Mach number; density fluctuations are of about its square
LEAST_REYNOLDS = 5.0         # Re_lambda from which on larger scales transfer energy to smaller ones
KMAX_ETA = 1.0, 4.0          # the least that resolves the dissipation, and more than any purpose needs
MOST_STEPS = 10**9           # of a flow or rollout, and frames: a quarter of an hour at a microsecond each
MOST_FORCED = 50             # how many times the energy of a flow the forcing may add in one step
SILENCE = -40.0              # logarithm of a share of the energy that is round-off
# Largest turnover time at the release of tracers over the expected one, of a flow with at least this Re_lambda.
LATER, TURBULENT = 3.0, 20.0


@dataclass(frozen=True)
class Context:
    """Ranks, machine and run directory, with which a scene is compared.

    Parameters
    ----------
    comm : the ranks that run the stages.
    stages, directory, variants : as of `eddies.stages.run_stages`.
    memory : of each node, in bytes; infinite: it is not compared.
    free_disk : free bytes where the run directory is; infinite: they are not compared.
    """

    comm: Comm
    stages: Sequence[str]
    directory: Path
    variants: Sequence[str] = ()
    memory: float = math.inf
    free_disk: float = math.inf


@dataclass(frozen=True)
class Problem:
    """A problem in words. `fatal`: `eddies run` refuses the scene; else it logs a warning."""

    text: str
    fatal: bool


def here(scene: Scene, comm: Comm) -> Context:
    """All stages of a scene in its own run directory on this machine; all ranks call it."""
    place = next(path for path in (scene.directory, *scene.directory.parents) if path.is_dir())
    free = on_first_rank(comm, lambda: shutil.disk_usage(place).free)
    return Context(comm, scene.stages_of_all, scene.directory, memory=memory_of_node(), free_disk=free)


def memory_of_node() -> int:
    """Physical memory of this node in bytes."""
    return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def problems(scene: Scene, context: Context) -> list[Problem]:
    """All problems of the stages of a scene, of all its variants; all ranks call it and get the same."""
    comm, planned = context.comm, steps(scene, context.stages, context.directory, context.variants)
    beside = node_ranks(comm)
    made = {step.directory / STAGES[stage].file for step in planned for stage in step.stages}
    refused: dict[str, None] = {}
    doubts: dict[str, list[str]] = {}
    for step in planned:
        refused |= dict.fromkeys(_refusals(step, comm, made))
        for doubt in _warnings(step, made):
            doubts.setdefault(doubt, []).append(step.variant or "")
        for stage in step.stages:
            size = memory(step.scene, stage, comm.size)
            if beside * size > context.memory:
                doubts[f"{stage}: {beside} ranks with about {in_units(size)} each need more than the "
                       f"{in_units(context.memory)} of memory here; take more nodes, or fewer cells or particles"] = []
    if "report" in context.stages:
        refused |= dict.fromkeys(place_problems(("report",), comm, context.directory))
    needed = most_disk((step.scene, stage) for step in planned for stage in step.stages)
    if needed > context.free_disk:
        doubts[f"the stages need about {in_units(needed)} of disk, and {in_units(context.free_disk)} are free here; "
               "choose another --output, or raise [tracers] frame_interval or field_every"] = []
    named = {text: ", ".join(dict.fromkeys(filter(None, names))) for text, names in doubts.items()}
    return [*(Problem(text, True) for text in refused),
            *(Problem(f"variant {names}: {text}" if names else text, False) for text, names in named.items())]


def refuse(scene: Scene, context: Context) -> list[str]:
    """Raise SceneError with the first fatal problem of a scene, or return its warnings; all ranks call it."""
    found = problems(scene, context)
    for problem in found:
        if problem.fatal:
            raise SceneError(problem.text)
    return [problem.text for problem in found]


# ---- problems that end a run


def _refusals(step: Step, comm: Comm, made: Collection[Path]) -> Iterator[str]:
    scene, stages = step.scene, step.stages
    for problem in (*_endless(scene, stages), *_too_few_frames(step, made), *rank_problems(scene, stages, comm.size),
                    *_single_writer(scene, stages, comm)):
        yield f"{scene.name}: {problem}"
    yield from place_problems(stages, comm, step.directory)
    yield from _unfit_files(step, comm, made)


def _endless(scene: Scene, stages: Sequence[str]) -> Iterator[str]:
    """A flow that the first step of the forcing makes unstable, that viscosity ends before the tracers do, or that
    takes too many steps."""
    forcing, initial, turbulence, tracers = scene.forcing, scene.initial, expected_turbulence(scene), scene.tracers
    if "dns" in stages and forcing is not None and initial.flow.rms is not None:
        step = scene.time.step or scene.time.max_step  # a weak flow has a long step
        unit = initial.flow.rms**2 / 2                 # energy over the square of the amplitude
        energy, gained = unit * initial.amplitude**2, forcing.injection_rate * step
        if gained > MOST_FORCED * energy:
            least = math.sqrt(gained / MOST_FORCED / unit)
            yield (f"[initial] amplitude = {initial.amplitude:g}: an energy of {energy:.2g}, to which [forcing] "
                   f"injection_rate = {forcing.injection_rate:g} adds {gained:.2g} in one step of {step:g}, which is "
                   f"unstable; raise amplitude to {least:.2g} or more, or lower injection_rate or [time] max_step")
    if "dns" in stages and tracers is not None and turbulence is not None and not tracers.forced:
        time = tracers.turnovers * turbulence.turnover_time
        exponent = -2 * scene.flow.viscosity * time    # of the largest modes, |k| = 1
        if exponent < SILENCE:
            yield (f"[flow] viscosity = {scene.flow.viscosity:g}: Re_lambda would be {turbulence.reynolds_lambda:.1g}, "
                   f"and less than exp({exponent:.3g}) of the flow's energy would remain after [tracers] turnovers = "
                   f"{tracers.turnovers:g}, a time of {time:.3g}; lower viscosity or turnovers")
    if "dns" in stages:
        expected, span = expected_step(scene), run_time(scene)
        if expected is not None and span is not None:
            yield from _too_many_steps(scene, span, *expected)
        if tracers is not None and turbulence is not None:
            yield from _too_many("[tracers] frame_interval", tracers.frame_interval, tracers.frame_interval,
                                 tracers.turnovers * turbulence.turnover_time)
    if "simulate" in stages:
        yield from _too_many_rollout_steps(scene, turbulence.turnover_time if turbulence else 0.0)


def _too_many(key: str, value: float | str, step: float, span: float) -> Iterator[str]:
    if not span <= MOST_STEPS * step:  # also where one is not a number
        yield (f"{key} = {value}: {span / step:.1e} steps of {step:.3g} for a time of {span:.3g}, and "
               f"{MOST_STEPS:.0e} are the most; raise it, or lower the turnovers or the duration of the run")


def _too_many_steps(scene: Scene, span: float, step: float, key: str) -> Iterator[str]:
    yield from _too_many(f"[time] {key}", getattr(scene.time, key), step, span)


def _too_many_rollout_steps(scene: Scene, turnover_time: float) -> Iterator[str]:
    settings = scene.simulation
    yield from _too_many("[simulation] step", settings.step, settings.longest_step,
                         max(settings.frame_interval, settings.turnovers * turnover_time))


def _too_few_frames(step: Step, made: Collection[Path]) -> Iterator[str]:
    """Too few frames of a ground truth that is yet to be made, even if the flow turns over as slowly as it may. A flow
    that decays before the tracers start, or is hardly turbulent, may have any turnover time."""
    scene, turbulence = step.scene, expected_turbulence(step.scene)
    unsure = step.holder("dns") / STAGES["dns"].file not in made or scene.spin_up is not None and scene.forcing is None
    if unsure or scene.tracers is None or turbulence is None or turbulence.reynolds_lambda < TURBULENT:
        return
    longest = LATER * scene.tracers.turnovers * turbulence.turnover_time
    frames = max(math.ceil(longest / scene.tracers.frame_interval), 1) + 1
    if frames <= MOST_STEPS:
        try:
            check_frames(step.stages, scene, scene.seen_in(step.holder("dns")), frames)
        except SceneError as error:
            yield (f"with at most {frames} frames, as expected of [tracers] turnovers = {scene.tracers.turnovers:g}: "
                   f"{error}")


def _single_writer(scene: Scene, stages: Sequence[str], comm: Comm) -> Iterator[str]:
    """Products that are too large for rank 0 to write for all."""
    for stage in stages if has_single_writer(comm) else ():
        size = disk(scene, stage) or 0.0
        if size > LARGEST_BYTES:
            yield (f"{STAGES[stage].file}: this h5py is built without MPI, so that rank 0 writes for {comm.size} "
                   f"ranks, up to {in_units(LARGEST_BYTES)} a file, and this will take {in_units(size)}; {REMEDY}")


def place_problems(stages: Sequence[str], comm: Comm, directory: Path) -> list[str]:
    """A run directory that is none or cannot be written, or in which something else has the name of a product."""
    def look() -> list[str]:
        if directory.is_dir() and not os.access(directory, os.W_OK | os.X_OK):
            return [f"{directory}: cannot be written; change its permissions, or choose another directory"]
        found = []
        for stage in [STAGES[name] for name in stages]:
            file, folder = (stage.file, stage.checkpoints) if stage.product is not None else (None, "report")
            for name, is_directory, makes in ((file, True, "writes a file"), (folder, False, "makes a directory")):
                if name and (directory / name).exists() and (directory / name).is_dir() == is_directory:
                    found.append(f"{directory / name}: is a {'directory' if is_directory else 'file'}, and `eddies "
                                 f"{stage.name}` {makes} of this name; move it away, or choose another directory")
        return found

    try:
        return on_first_rank(comm, look)
    except OSError as error:
        return [f"{directory}: cannot be used ({error.strerror}); choose another --output"]


def _unfit_files(step: Step, comm: Comm, made: Collection[Path]) -> Iterator[str]:
    """A file to start from, trained weights or other ground truths that do not fit; a missing GPU. Weights that earlier
    steps make are not read."""
    scene, stages, model = step.scene, step.stages, step.scene.model if "train" in step.stages else None
    try:
        if "dns" in stages and scene.initial.flow.from_file:
            with stored_states(scene.initial, comm):
                pass
        weights = model.weights_file if model is not None and model.path is not None else None
        if weights is not None and weights not in made and on_first_rank(comm, weights.is_file):
            from eddies.workflows.learned.source import read_source  # imports torch
            read_source(scene, comm)
        if scene.device != "cpu" and {"train", "simulate"} & {*stages}:
            from eddies.particles.devices import prepare_torch  # imports torch
            prepare_torch(scene.device, comm)
    except UserError as error:
        yield str(error)
    if model is not None and model.path is None and scene.training.truths is not None:
        from eddies.workflows.learned.truths import truth_problems  # imports torch
        own_file = step.holder("dns") / STAGES["dns"].file
        for problem in truth_problems(scene.training, scene.tracers, model.reads, own_file, comm):
            yield f"{scene.name}: {problem}"


# ---- reasons to doubt a result


def _warnings(step: Step, made: Collection[Path]) -> Iterator[str]:
    """Warnings of the stages of a step; earlier steps write the files that are `made`."""
    for stage in step.stages:
        for subject in SUBJECTS.get(stage, ()):
            yield from subject(step.scene)
    if "simulate" in step.stages:
        yield from beyond_truth(step.scene, step.scene.seen_in(step.holder("dns")))
    model = step.scene.model if "train" in step.stages else None
    if model is not None and model.path and model.weights_file not in made and not model.weights_file.is_file():
        yield f'[model] path = "{model.path}": there is no {model.weights_file} yet, which `eddies train` needs'


def resolution(scene: Scene) -> Iterator[str]:
    """A grid too coarse for the dissipation, or much finer than it needs."""
    turbulence, k_max, (least, most) = expected_turbulence(scene), largest_wavenumber(scene), KMAX_ETA
    if turbulence is None:
        return
    reached = k_max * turbulence.kolmogorov_length
    cells = math.ceil(3 * least / turbulence.kolmogorov_length) + 1
    if reached < least * (1 - 1e-3):
        viscosity = (least / k_max) ** (4 / 3) * turbulence.dissipation_rate ** (1 / 3)
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, below {least:g}, so that the "
               f"dissipation is not resolved; raise cells to {cells}, or viscosity to {at_least(viscosity)}")
    elif reached > most:
        yield (f"[flow] cells = {scene.flow.cells}: k_max eta is about {reached:.2g}, and 1 to 2 resolve the "
               f"dissipation: a step costs {(reached / 2)**3:.0f} times as much as necessary; lower cells to "
               f"{2 * cells}")


def compressibility(scene: Scene) -> Iterator[str]:
    """Sound too slow for the flow."""
    speed, sound = rms_speed(scene), scene.flow.sound_speed
    if speed is None or sound is None or speed <= LARGEST_MACH * sound:
        return
    reason = "the flow is supersonic, and shocks are not resolved" if speed > sound else (
        f"above {LARGEST_MACH:g}, and fluid, balanced start and models assume a nearly uniform density")
    yield (f"[flow] sound_speed = {sound:g}: the turbulent Mach number is about {speed / sound:.2g}: {reason}; raise "
           f"sound_speed to {at_least(speed / LARGEST_MACH)} or more")


def turbulence_at_all(scene: Scene) -> Iterator[str]:
    """Viscosity that leaves no turbulence."""
    turbulence = expected_turbulence(scene)
    if turbulence is not None and turbulence.reynolds_lambda < LEAST_REYNOLDS:
        reached = turbulence.reynolds_lambda
        why = ("the flow is laminar" if reached < 1 else f"below {LEAST_REYNOLDS:g}, and eddies decay without making "
               "smaller ones")
        yield (f"[flow] viscosity = {scene.flow.viscosity:g}: Re_lambda is about {reached:.2g}: {why}; lower viscosity "
               f"to {at_most(scene.flow.viscosity * (reached / LEAST_REYNOLDS)**2)} or less")


def stability(scene: Scene) -> Iterator[str]:
    """Steps of the direct simulation beyond the limits of its stepper."""
    settings, bound = scene.time, courant_bound(scene)
    step = settings.step or min(bound or 0.0, settings.max_step)
    for limit in limits_of_step(largest_wavenumber(scene), step, peak_speed(scene) or 0.0, scene.flow.viscosity,
                                settings.explicit, scene.flow.sound_speed):
        if limit.exceeded:
            key = "step" if settings.step else "max_step" if limit.name == "viscosity" else "courant"
            yield f"[time] {key} = {getattr(settings, key):g}: is unstable by {limit}; {REMEDIES[limit.name]}"


def filter_width(scene: Scene) -> Iterator[str]:
    """A filter that filters nothing, or removes the flow."""
    if scene.tracers is None:
        return
    width, forcing = scene.tracers.filter_width, scene.forcing
    if width < BOX_LENGTH / scene.flow.cells:
        yield (f"[tracers] filter_width = {width:.3g}: is narrower than a cell of the grid, so that nothing is "
               f"filtered; raise it to {at_least(BOX_LENGTH / scene.flow.cells)} or more")
    if forcing or scene.initial.flow.turbulent:
        highest = forcing.wavenumber if forcing else scene.initial.peak_wavenumber
        if math.pi / width < highest * (1 - 1e-9):
            yield (f"[tracers] filter_width = {width:.3g}: passes wavenumbers up to {math.pi / width:.2g}, and the "
                   f"energy is at {highest:g}; lower it to {at_most(math.pi / highest)} or less, or raise "
                   "particles_per_side")


def untrained_terms(scene: Scene) -> Iterator[str]:
    """Terms that nothing trains."""
    if scene.training and scene.model.path is None and scene.training.horizons is None:
        for name, settings in scene.model.settings.items():
            if settings.learns_through_horizons:
                yield (f'[model] terms: "{name}" is trained through horizons alone, and keeps its initial parameters '
                       "without them: add [training.horizons]")


def rollout_steps(scene: Scene) -> Iterator[str]:
    """Steps of the particles that are too long for the forced flow or for a term."""
    settings, speed = scene.simulation, rms_speed(scene)
    if "model" not in settings.needs or math.isinf(settings.longest_step):
        return
    allowed = expected_allowed_step(scene) if scene.injects else None
    if allowed and settings.longest_step > allowed * (1 + 1e-9):
        yield (f"[simulation] step = {settings.step:g}: the particles will take shorter steps, of about "
               f"{at_most(allowed)}, in which their resolved velocity can follow the flow; lower it to that")
    units = StepUnits(radius=scene.interaction_radius, filter_width=scene.tracers.filter_width,
                      sound_speed=scene.flow.sound_speed, scheme=settings.scheme,
                      velocity=None if speed is None else speed / math.sqrt(3))
    for name, term in scene.model.settings.items():
        longest = term.longest_step(units)
        if settings.longest_step > longest:
            yield f"[simulation] step = {settings.step:g}: " + term.too_long.format(
                name=name, longest=at_most(longest), integrator=settings.scheme.name)


def beyond_truth(scene: Scene, seen: float) -> Iterator[str]:
    """A rollout that goes on after the end of its ground truth; training has `seen` this fraction of it.

    Later frames of a flow that is forced throughout are compared with the mean of the ground truth.
    """
    settings, tracers, start = scene.simulation, scene.tracers, scene.simulation.start
    start = seen if start is None else start
    left = (1 - start) * tracers.turnovers
    if settings.turnovers > left * (1 + 1e-9) and not tracers.forced:
        yield (f"[simulation] turnovers = {settings.turnovers:g}: the ground truth ends {left:.3g} turnovers after its "
               f"start, and later frames are compared with nothing; lower it to {at_most(left)}, or raise [tracers] "
               f"turnovers to {at_least(tracers.turnovers * settings.turnovers / left)}")


SUBJECTS: dict[str, tuple[Callable[[Scene], Iterator[str]], ...]] = {
    "dns": (resolution, compressibility, turbulence_at_all, stability, filter_width),
    "train": (untrained_terms,), "simulate": (rollout_steps,)}


def two_digits(rounded: Callable[[float], int], value: float) -> str:
    """A number with two digits, `rounded` by math.floor or math.ceil."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{rounded(round(value / digit, 9)) * digit:.2g}"


at_least, at_most = partial(two_digits, math.ceil), partial(two_digits, math.floor)


# ---- problems that only the flow shows


def check_span(scene: Scene, span: float, bound: float, frames: bool = False) -> None:
    """Raise SceneError where a flow at rest never turns over, or where the present flow takes too many steps in a time
    `span`, or with `frames` stores too many frames. `bound` is the longest step that the flow allows now."""
    if span == math.inf:
        raise SceneError(f"{scene.name}: the flow is at rest, so that it never turns over; start from another one")
    settings = scene.time
    key = "step" if settings.step else "max_step" if bound >= settings.max_step else "courant"
    interval = scene.tracers.frame_interval if scene.tracers and frames else math.inf
    for problem in [*_too_many_steps(scene, span, settings.step or min(bound, settings.max_step), key),
                    *_too_many("[tracers] frame_interval", interval, interval, span)]:
        raise SceneError(f"{scene.name}: {problem}")


def check_ground_truth(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path) -> None:
    """Raise SceneError where the ground truth of a run directory has too few frames for some stages, or scales that
    vanish; all ranks call it."""
    path = directory / STAGES["dns"].file
    with open_product(comm, path, "ground_truth") as file:
        check_frames(stages, scene, scene.seen_in(directory), len(Trajectory(file, "tracers").times))
        if {"train", "simulate"} & {*stages}:
            from eddies.workflows.ground_truth.truth import GroundTruth  # imports torch
            truth = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes))
            try:
                truth.scales
            except ScaleError as error:
                raise SceneError(f"{path}: {error}") from None
            turnover_time = truth.reference["eddy_turnover_time"]
            for problem in _too_many_rollout_steps(scene, turnover_time) if "simulate" in stages else ():
                raise SceneError(f"{scene.name}: {problem}")
