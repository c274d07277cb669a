"""Problems of a scene, of the machine and of the run directory, found before any work.

Each text names the key, its value, the reason and a remedy.
"""

import math
import os
import shutil
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

from eddies.clock import SAME, rounded_up
from eddies.errors import UserError
from eddies.flow.initial_fields import SPEEDS
from eddies.flow.stability import REMEDIES, limits_of_step
from eddies.import_path import is_path
from eddies.io.hdf5 import open_product
from eddies.io.provenance import product_provenance
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm, node_ranks
from eddies.parallel.reduction import global_min
from eddies.particles.flow_units import ScaleError, allowed_step, planes_for, resolved_shells
from eddies.pipeline import STAGES
from eddies.scene.integrators import SCHEMES
from eddies.scene.rules import quoted
from eddies.scene.scene import (BOX_LENGTH, Flow, Forcing, Initial, Model, Reconstruction, Scene, SceneError,
                                Simulation, Time, Tracers, Tracks, Training)
from eddies.scene.terms import StepUnits
from eddies.workflows.estimates import (Estimates, Measured, Storage, estimate, expected_scales, forces_rollout,
                                        in_units, most_disk, most_ranks, storage)
from eddies.workflows.ground_truth.frame_counts import check_frames
from eddies.workflows.ground_truth.scene_flow import given_spectrum, stored_states
from eddies.workflows.learned.source import ModelDefinition, read_source, seen_by, seen_flows, start_within_training
from eddies.workflows.run_directory.work import read_found_step
from eddies.workflows.variants import Step

LARGEST_MACH = 0.3           # turbulent Mach number; the relative density fluctuations are about the square of it
LEAST_REYNOLDS = 5.0         # Re_lambda above which large scales transfer energy to small ones
KMAX_ETA = 1.0, 4.0          # least k_max eta that resolves the dissipation; largest useful k_max eta
MOST_STEPS = 10**9           # steps of a flow or rollout, or frames: they take a quarter of an hour at 1 us each
MOST_FORCED = 50             # largest energy that the forcing may add in one step, divided by that of the flow
LOG_NEGLIGIBLE_ENERGY = -40.0  # logarithm of the share of the energy below which only round-off remains
# Largest ratio of the turnover time at the release of tracers to the expected one; least Re_lambda for this limit.
LARGEST_TURNOVER_RATIO, TURBULENT = 3.0, 20.0


def free_disk_at(directory: Path, comm: Comm) -> float:
    """Return the free bytes on the disk of a directory; all ranks call it. The directory need not exist."""
    place = next(path for path in (directory, *directory.parents) if path.is_dir())
    return float(on_first_rank(comm, lambda: shutil.disk_usage(place).free))


def memory_of_node(comm: Comm) -> float:
    """Return the physical memory in bytes of the node with the least memory; all ranks call it."""
    return float(global_min(comm, os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")))


def problems(scene: Scene, planned: Sequence[Step], comm: Comm, memory: float = math.inf,
             free_disk: float = math.inf, measured: Measured = {}) -> tuple[list[str], list[str]]:
    """Return two lists of problems of the planned steps of a scene; all ranks call it and get the same lists.

    `eddies run` refuses the scene if the first list is not empty. The second list holds warnings. `memory` is the
    memory of a node and `free_disk` the free disk space, both in bytes. If one is infinite, it is not checked.
    `measured` is what `measure` has found in the files of the scene.
    """
    on_node = node_ranks(comm)
    made = {file for step in planned for file in step.files}
    refused: dict[str, None] = {}
    doubts: dict[str, list[str]] = {}
    needs: list[Storage] = []
    learned: dict[Path, dict[str, float]] = {}  # the flows that each model of the planned steps has seen
    for step in planned:
        own, stages = step.scene, step.stages
        refused |= dict.fromkeys(f"{own.name}: {problem}" for problem in _infeasible(step, comm, made, measured))
        refused |= dict.fromkeys(directory_problems(stages, comm, step.directory))
        refused |= dict.fromkeys(_unfit_files(step, comm, made))
        within = on_first_rank(comm, partial(_start_within_training, step, learned))
        for doubt in (*_warnings(step, made, measured), *within):
            doubts.setdefault(doubt, []).append(step.variant or "")
        for stage in stages:
            needs.append(storage(own, stage, comm.size, measured))
            if on_node * needs[-1].memory > memory:
                text = (f"{stage}: {on_node} ranks with about {in_units(needs[-1].memory)} each need more than the "
                        f"{in_units(memory)} of memory here; take more nodes, ")
                if own.tracks is not None and own.tracks.volume is not None:
                    refused[f"[tracks] volume: the cube around it is too large in the stage {text}a smaller margin, or "
                            "fewer tracks"] = None
                else:
                    doubts[f"{text}or fewer cells or particles"] = []
    needed = most_disk(needs)
    if scene.sets and scene.kernel is not None and not scene.variant:
        doubts[f"[tracers] set: is absent, so that only the ground truths of {', '.join(scene.sets)} are made; "
               "choose one of them for kernel, model and rollout"] = []
    initial = scene.initial
    if scene.realisations and not initial.flow.seeded and not initial.flow.from_file:
        doubts[f'realisations: [initial] kind = "{initial.kind}" does not depend on the seed, so all realisations are '
               "the same flow, with other places of the particles; choose another kind, or remove realisations"] = []
    if needed > free_disk:
        doubts[f"the stages need about {in_units(needed)} of disk, and {in_units(free_disk)} are free here; "
               "choose another --output, or raise [tracers] frame_interval or field_every"] = []
    named = {text: ", ".join(dict.fromkeys(filter(None, names))) for text, names in doubts.items()}
    return [*refused], [f"variant {names}: {text}" if names else text for text, names in named.items()]


# ---- problems that end a run


def _infeasible(step: Step, comm: Comm, made: Collection[Path], measured: Measured) -> Iterator[str]:
    """Yield each reason why a step cannot work.

    The reasons are an unstable or decayed flow; too many steps, frames, ranks or bytes; too few frames; and ground
    truths of other runs that do not fit. `made` are the files that the planned steps write.
    """
    scene, stages, expected = step.scene, step.stages, estimate(step.scene, measured)
    tracers, scales, directory = scene.tracers, expected.scales, step.links.get("dns", step.directory)
    truth, turnover_time = directory / STAGES["dns"].file, scales["eddy_turnover_time"] if scales else 0.0
    if "dns" in stages:
        if scene.forcing is not None:
            yield from _strong_forcing(scene.initial, scene.forcing, scene.time)
        if tracers is not None and scales is not None:
            yield from _decay(scene.flow, tracers, scales)
        if expected.step is not None and expected.run_time is not None:
            yield from _too_many_steps(scene.time, expected.limited_by, expected.step, expected.run_time)
        if tracers is not None and scales is not None:
            yield from _too_many_frames(tracers, tracers.turnovers * turnover_time)
    if "simulate" in stages:
        yield from _too_many_rollout_steps(scene.simulation, turnover_time)
    # No upper limit of the turnover time is known if the flow decays before the tracers start, or is hardly turbulent.
    decays = scene.spin_up is not None and scene.forcing is None
    if tracers is not None and scales is not None and scales["reynolds_lambda"] >= TURBULENT and (
            not decays and truth in made):
        yield from _too_few_frames(scene, stages, turnover_time, scene.seen_in(directory))
    limits = most_ranks(scene.ground_truth_alone if set(stages) == {"dns"} else scene, measured)
    yield from rank_problems(limits, comm.size)
    if "train" in stages and scene.model.path is None and scene.training.truths is not None:
        from eddies.workflows.learned.training_data import truth_problems  # imports torch
        yield from truth_problems(scene.training, tracers, scene.model.reads, truth, comm)


def rank_problems(limits: Mapping[str, int], ranks: int) -> Iterator[str]:
    """Yield a message if there are more ranks than the strictest limit allows."""
    reason = min(limits, key=limits.__getitem__)
    if ranks > limits[reason]:
        yield (f"{ranks} ranks are more than the limit of {limits[reason]} ({reason}); start at most {limits[reason]}. "
               "`eddies check` lists all limits")


def _strong_forcing(initial: Initial, forcing: Forcing, time: Time) -> Iterator[str]:
    """Yield a problem if the first step of the forcing makes the flow unstable."""
    if initial.kind in SPEEDS:
        step = time.step or time.max_step  # a weak flow takes the longest step
        unit = SPEEDS[initial.kind][0]**2 / 2  # energy divided by the square of the amplitude
        energy, gained = unit * initial.amplitude**2, forcing.injection_rate * step
        if gained > MOST_FORCED * energy:
            least = math.sqrt(gained / MOST_FORCED / unit)
            yield (f"[initial] amplitude = {initial.amplitude:g}: the flow has the energy {energy:.2g}, and [forcing] "
                   f"injection_rate = {forcing.injection_rate:g} adds {gained:.2g} in one step of {step:g}, which is "
                   f"unstable; raise amplitude to {least:.2g} or more, or lower injection_rate or [time] max_step")


def _decay(flow: Flow, tracers: Tracers, scales: Mapping[str, float]) -> Iterator[str]:
    """Yield a problem if viscosity brings the flow to rest before the tracers reach their end."""
    time = tracers.turnovers * scales["eddy_turnover_time"]
    exponent = -2 * flow.viscosity * time  # of the decay of energy at the largest scales, |k| = 1
    if exponent < LOG_NEGLIGIBLE_ENERGY and not tracers.forced:
        yield (f"[flow] viscosity = {flow.viscosity:g}: Re_lambda would be {scales['reynolds_lambda']:.1g}, and less "
               f"than exp({exponent:.3g}) of the flow's energy would remain after [tracers] turnovers = "
               f"{tracers.turnovers:g}, a time of {time:.3g}; lower viscosity or turnovers")


def _too_many_rollout_steps(settings: Simulation, turnover_time: float) -> Iterator[str]:
    yield from _too_many("[simulation] step", settings.step, settings.longest_step,
                         max(settings.frame_interval, settings.turnovers * turnover_time))


def _too_many_steps(time: Time, key: str, step: float, span: float) -> Iterator[str]:
    yield from _too_many(f"[time] {key}", getattr(time, key), step, span)


def _too_many_frames(tracers: Tracers, span: float) -> Iterator[str]:
    yield from _too_many("[tracers] frame_interval", tracers.frame_interval, tracers.frame_interval, span)


def _too_many(key: str, value: float | str, step: float, span: float) -> Iterator[str]:
    if not span <= MOST_STEPS * step:  # also if span or step is not a number
        yield (f"{key} = {value}: {span / step:.1e} steps of {step:.3g} for a time of {span:.3g}, more than the limit "
               f"of {MOST_STEPS:.0e}; raise this key, or lower the turnovers or the duration of the run")


def _too_few_frames(scene: Scene, stages: Sequence[str], turnover_time: float, seen: float) -> Iterator[str]:
    """Yield a problem if there are too few frames even at the longest possible turnover time."""
    tracers = scene.tracers
    frames = max(rounded_up(LARGEST_TURNOVER_RATIO * tracers.turnovers * turnover_time / tracers.frame_interval), 1) + 1
    if frames <= MOST_STEPS:
        try:
            check_frames(stages, scene, seen, frames)
        except SceneError as error:
            yield f"[tracers] turnovers = {tracers.turnovers:g} is expected to give at most {frames} frames: {error}"


def directory_problems(stages: Sequence[str], comm: Comm, directory: Path) -> list[str]:
    """Return the problems of a run directory: it cannot be used, or a file or directory in it blocks the name of a
    product."""
    def look() -> list[str]:
        if directory.is_dir() and not os.access(directory, os.W_OK | os.X_OK):
            return [f"{directory}: cannot be written; change its permissions, or choose another directory"]
        found = []
        for stage in [STAGES[name] for name in stages]:
            for name, is_directory, makes in ((stage.file, True, "writes a file"),
                                              (stage.folder, False, "makes a directory")):
                if name and (directory / name).exists() and (directory / name).is_dir() == is_directory:
                    found.append(f"{directory / name}: is a {'directory' if is_directory else 'file'}, and `eddies "
                                 f"{stage.name}` {makes} of this name; move it away, or choose another directory")
        return found

    try:
        return on_first_rank(comm, look)
    except OSError as error:
        return [f"{directory}: cannot be used ({error.strerror}); choose another --output"]


def _unfit_files(step: Step, comm: Comm, made: Collection[Path]) -> Iterator[str]:
    """Yield a problem if a step needs the file of an initial flow, of points or of trained weights that cannot be used,
    or a device that does not exist. Weights in `made`, the files that the planned steps write, are not read."""
    scene, stages = step.scene, step.stages
    initial, weights = scene.initial, scene.model.weights_file if "train" in stages else None
    try:
        if "dns" in stages and scene.tracks is None and initial.flow.from_file:
            with stored_states(initial, comm):
                pass
        if "dns" in stages and scene.tracks is None and initial.kind == "spectrum":
            given_spectrum(initial, comm)
        points = scene.reconstruction.points_file if "reconstruct" in stages else None
        if points is not None:
            from eddies.workflows.track_source import check_points  # imports torch
            on_first_rank(comm, partial(check_points, points, scene.tracks))
        if weights is not None and weights not in made and on_first_rank(comm, weights.is_file):
            read_source(scene.name, ModelDefinition.of(scene), comm)
        if "simulate" in stages and (path := scene.simulation.step_file) is not None and path not in made:
            yield from _unfit_step(scene.simulation, path, comm)
        if scene.device != "cpu" and {"train", "simulate"} & {*stages}:
            from eddies.particles.devices import prepare_torch  # imports torch
            prepare_torch(scene.device, comm)
    except UserError as error:
        yield str(error)


def _unfit_step(settings: Simulation, path: Path, comm: Comm) -> Iterator[str]:
    """Yield a problem if the converged step of another run is that of another kind of method."""
    integrator = read_found_step(path, comm)[0]["integrator"]
    if (integrator in SCHEMES) == settings.form.on_grid:
        kinds = "particles", "a coarse grid"
        of, needed = kinds if settings.form.on_grid else kinds[::-1]
        yield (f"[simulation] step_from = {quoted(settings.step_from)}: has the converged step of {of} ({integrator}), "
               f"and this rollout is one of {needed}; name a run of the same method, or remove step_from")


# ---- reasons to doubt a result


def _warnings(step: Step, made: Collection[Path], measured: Measured) -> Iterator[str]:
    """Yield the warnings about the stages of a step. `made` are the files that the planned steps of the scene write."""
    scene, stages, expected = step.scene, step.stages, estimate(step.scene, measured)
    tracers, model, training, simulation = scene.tracers, scene.model, scene.own_training, scene.simulation
    if "dns" in stages and scene.tracks is None:
        yield from inviscid_turbulence(scene.flow, scene.initial, scene.forcing)
        if expected.scales is not None:
            yield from resolution(scene.flow, expected.scales)
            yield from laminar_flow(scene.flow, expected.scales)
        yield from compressibility(scene.flow, expected.rms_speed)
        yield from stability(scene.flow, scene.time, expected)
        for each in tracers.all if tracers is not None else ():
            yield from filter_width(each, scene.flow, expected.scales)
    if "reconstruct" in stages:
        yield from spoiled_quantities(scene.reconstruction, (scene.tracks or tracers).filtered, scene.tracks)
    if "train" in stages and training is not None:
        yield from untrained_terms(model, training)
    if "simulate" in stages:
        if "model" in simulation.form.needs and not math.isinf(simulation.longest_step):
            speed, scales, allowed = expected.rms_speed, expected.scales, None
            if forces_rollout(scene) and scales is not None:
                shells = resolved_shells(tracers.spacing, tracers.filter_width, scales["kolmogorov_length"], BOX_LENGTH,
                                         planes_for(tracers.particles))
                allowed = allowed_step(simulation.scheme.angle, shells, scales["velocity_rms"])
            yield from rollout_steps(simulation, allowed, model, StepUnits(
                radius=ModelDefinition.of(scene).radius, filter_width=tracers.filter_width,
                sound_speed=scene.flow.sound_speed, velocity=None if speed is None else speed / math.sqrt(3),
                scheme=simulation.scheme))
        yield from beyond_truth(simulation, tracers, scene.seen_in(step.links.get("dns", step.directory)))
    if "train" in stages and model.path and model.weights_file not in made and not model.weights_file.is_file():
        yield (f'[model] path = "{model.path}": `eddies train` needs {model.weights_file}, which does not exist yet; '
               "train that model first, or give another path")


def _start_within_training(step: Step, learned: dict[Path, dict[str, float]]) -> list[str]:
    """Return a warning, in a list, if the rollout of a step starts within the training of its model. `learned` maps the
    model files of earlier steps to the flows that these models have seen; that of this step is added."""
    scene, directory = step.scene, step.links.get("dns", step.directory)
    if scene.model is None or not {"train", "simulate"} & {*step.stages}:
        return []
    weights = scene.model.weights_file
    if weights is None:
        seen = seen_flows(scene, directory)
    else:
        seen = learned[weights] if weights in learned else seen_by(product_provenance(weights), weights.parent)
    learned[step.directory / STAGES["train"].file] = seen
    found = start_within_training(scene, directory, seen) if "simulate" in step.stages else None
    return [] if found is None else [found]


def inviscid_turbulence(flow: Flow, initial: Initial, forcing: Forcing | None) -> Iterator[str]:
    """Yield a warning if nothing dissipates the energy of a turbulent or forced flow."""
    forced = forcing is not None and forcing.injection_rate > 0
    if flow.viscosity > 0 or is_path(flow.fluid) or not (forced or initial.flow.turbulent):
        return
    viscosity = (KMAX_ETA[0] / flow.largest_wavenumber) ** (4 / 3) * (
        expected_scales(replace(flow, viscosity=1.0), initial, forcing)["dissipation_rate"] ** (1 / 3))
    fate = ("the energy of [forcing] is never dissipated, so the flow has no stationary state" if forced else
            "no energy is dissipated, so it gathers at the smallest scales of the grid")
    yield (f"[flow] viscosity = 0: {fate}, and k_max eta, which tells whether a grid resolves the smallest scales, has "
           f"no value; raise viscosity to {at_least(viscosity)}{', or remove [forcing]' if forced else ''}")


def resolution(flow: Flow, scales: Mapping[str, float]) -> Iterator[str]:
    """Yield a warning if the grid is too coarse for the dissipation, or much finer than necessary."""
    reached, (least, most) = scales["kmax_eta"], KMAX_ETA
    cells = convenient(math.ceil(3 * least / scales["kolmogorov_length"]) + 1)
    if reached < least * (1 - 1e-3):
        viscosity = (least / flow.largest_wavenumber) ** (4 / 3) * scales["dissipation_rate"] ** (1 / 3)
        yield (f"[flow] cells = {flow.cells}: k_max eta is about {reached:.2g}, below {least:g}, so that the "
               f"dissipation is not resolved; raise cells to {cells}, or viscosity to {at_least(viscosity)}")
    elif reached > most:
        yield (f"[flow] cells = {flow.cells}: k_max eta is about {reached:.2g}, but 1 to 2 resolve the dissipation: a "
               f"step costs {(reached / 2)**3:.0f} times as much as necessary; lower cells to {convenient(2 * cells)}")


def convenient(cells: int) -> int:
    """Return an even number, equal to `cells` or slightly larger, without prime factors above 7. Transforms on other
    grids are slower."""
    factors = [2 * 3**threes * 5**fives * 7**sevens for threes in range(4) for fives in range(4) for sevens in range(2)]
    return min(factor << (-(-cells // factor) - 1).bit_length() for factor in factors)


def compressibility(flow: Flow, speed: float | None) -> Iterator[str]:
    """Yield a warning if the sound speed is too low for the flow."""
    sound = flow.sound_speed
    if speed is None or sound is None or speed <= LARGEST_MACH * sound:
        return
    reason = "the flow is supersonic, and shocks are not resolved" if speed > sound else (
        f"above {LARGEST_MACH:g}, but the fluid, its initial density and the models assume a nearly uniform density")
    yield (f"[flow] sound_speed = {sound:g}: the turbulent Mach number is about {speed / sound:.2g}: {reason}; raise "
           f"sound_speed to {at_least(speed / LARGEST_MACH)} or more")


def laminar_flow(flow: Flow, scales: Mapping[str, float]) -> Iterator[str]:
    """Yield a warning if the viscosity is too high for turbulence."""
    reached = scales["reynolds_lambda"]
    if reached < LEAST_REYNOLDS:
        why = ("the flow is laminar" if reached < 1 else f"below {LEAST_REYNOLDS:g}, and eddies decay without making "
               "smaller ones")
        yield (f"[flow] viscosity = {flow.viscosity:g}: Re_lambda is about {reached:.2g}: {why}; lower viscosity to "
               f"{at_most(flow.viscosity * (reached / LEAST_REYNOLDS)**2)} or less")


def stability(flow: Flow, time: Time, expected: Estimates) -> Iterator[str]:
    """Yield a warning for each limit of the stepper that the steps of the direct simulation exceed."""
    step = time.step or min(expected.courant_step or 0.0, time.max_step)
    for limit in limits_of_step(flow.largest_wavenumber, step, expected.peak_speed or 0.0, flow.viscosity,
                                time.explicit, flow.sound_speed):
        if limit.exceeded:
            key = "step" if time.step else "max_step" if limit.name == "viscosity" else "courant"
            yield f"[time] {key} = {getattr(time, key):g}: is unstable by {limit}; {REMEDIES[limit.name]}"


def filter_width(tracers: Tracers, flow: Flow, scales: Mapping[str, float] | None) -> Iterator[str]:
    """Yield a warning if the filter is narrower than a cell, or wider than the integral scale, so that it removes much
    of the energy. `scales` are those of the turbulence, if known."""
    width, cell = tracers.filter_width, BOX_LENGTH / flow.cells
    if width < cell:
        yield (f"[tracers] filter_width = {width:.3g}: is narrower than a cell of the grid, so that nothing is "
               f"filtered; raise it to {at_least(cell)} or more")
    if scales is not None and width > scales["integral_scale"] * (1 + 1e-9):
        yield (f"[tracers] filter_width = {width:.3g}: is wider than the integral scale, "
               f"{scales['integral_scale']:.3g}, so that the filter removes much of the energy; lower it to "
               f"{at_most(scales['integral_scale'])} or less, or raise particles_per_side")


def spoiled_quantities(settings: Reconstruction, filtered: bool, tracks: Tracks | None) -> Iterator[str]:
    """Yield a warning if the pressure or the acceleration is to be reconstructed from neighbours of filtered tracks, or
    in a volume that is not periodic. Both depend on the velocity before the filter, and on that in the whole cube."""
    wanted = " and ".join(name for name in ("pressure", "acceleration") if name in settings.fields)
    if filtered and settings.of_neighbors and wanted:
        yield (f'[reconstruction] method = "{settings.method}": the {wanted} will be useless, because undoing the '
               "filter of the tracks amplifies the errors of estimates from neighbours; set method = "
               f'"least-squares" or "memory", or remove {wanted} from fields')
    if tracks is not None and tracks.volume is not None and wanted:
        yield (f"[tracks] volume: the {wanted} will be inaccurate even inside the volume, because the velocity beyond "
               f"it, which is guessed, has a part in them; remove {wanted} from [reconstruction] fields")


def untrained_terms(model: Model, training: Training) -> Iterator[str]:
    """Yield a warning for each term whose parameters are not trained."""
    for name, settings in model.settings.items():
        if settings.learns_through_horizons and training.horizons is None:
            yield (f'[model] terms: only [training.horizons] trains the term "{name}", and the scene lacks this '
                   "section, so the term keeps its initial parameters; add [training.horizons]")


def rollout_steps(settings: Simulation, allowed: float | None, model: Model, units: StepUnits) -> Iterator[str]:
    """Yield warnings if the steps of the particles are too long. `allowed` is the longest step in the resolved velocity
    of a forced flow, None without a limit. Each term of the model has a limit of its own."""
    if allowed and settings.longest_step > allowed * (1 + 1e-9):
        yield (f"[simulation] step = {settings.step:g}: is too long for the resolved velocity to follow the flow, so "
               f"the particles will take steps of about {at_most(allowed)}; lower step to {at_most(allowed)}")
    for name, term in model.settings.items():
        longest = term.longest_step(units)
        if settings.longest_step > longest:
            yield f"[simulation] step = {settings.step:g}: " + term.too_long.format(
                name=name, longest=at_most(longest), integrator=settings.scheme.name)


def beyond_truth(settings: Simulation, tracers: Tracers, seen: float) -> Iterator[str]:
    """Yield a warning if a rollout ends after its ground truth. `seen` is the share of the ground truth that training
    uses.

    A flow that is forced throughout gives no warning, because later frames are compared with the mean of the ground
    truth.
    """
    left = (1 - (seen if settings.start is None else settings.start)) * tracers.turnovers
    if settings.turnovers > left * (1 + 1e-9) and not tracers.forced:
        yield (f"[simulation] turnovers = {settings.turnovers:g}: the ground truth ends {left:.3g} turnovers after the "
               f"start of the rollout, so later frames cannot be compared; lower it to {at_most(left)}, or raise "
               f"[tracers] turnovers to {at_least(tracers.turnovers * settings.turnovers / left)}")


def two_digits(rounded: Callable[[float], int], value: float) -> str:
    """Return a number as text with two significant digits. `rounded` is math.floor or math.ceil."""
    digit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return f"{rounded(round(value / digit, 9)) * digit:.2g}"


at_least, at_most = partial(two_digits, math.ceil), partial(two_digits, math.floor)


# ---- problems that show during the run


def check_span(time: Time, now: float, span: float, bound: float, tracers: Tracers | None = None) -> None:
    """Raise SceneError for a flow at rest, or if the time `span` takes too many steps, or vanishes beside the time
    `now`.

    With `tracers`, also raise it if this time has too many frames, or if their interval vanishes. `bound` is the
    longest step that the present flow allows. A flow at rest has an infinite `span`.
    """
    if span == math.inf:
        raise SceneError("the flow is at rest, so that it never turns over; set another [initial] kind or amplitude")
    shortest = tracers.frame_interval if tracers else span
    if SAME * shortest < math.ulp(now):
        place = f"[tracers] frame_interval = {shortest:g}" if tracers else f"[time] duration = {shortest:g}"
        raise SceneError(f"{place}: is lost in the rounding of the time {now:g} at which it begins; raise it, or "
                         "shorten [spin_up]")
    key = "step" if time.step else "max_step" if bound >= time.max_step else "courant"
    for problem in [*_too_many_steps(time, key, time.step or min(bound, time.max_step), span),
                    *(_too_many_frames(tracers, span) if tracers else ())]:
        raise SceneError(problem)


def check_ground_truth(path: Path, stages: Sequence[str], scene: Scene, comm: Comm) -> None:
    """Raise SceneError if a ground truth cannot be used by `stages` of a scene; all ranks call it.

    The reasons are too few frames; a scale that is 0; and too many steps of the rollout.
    """
    with open_product(comm, path, "ground_truth") as file:
        if "particles" not in file:  # measured tracks of which none is in all frames; only fields are made from them
            return
        check_frames(stages, scene, scene.seen_in(path.parent), len(Trajectory(file, "tracers").times))
        if {"train", "simulate"} & {*stages}:
            from eddies.workflows.ground_truth.truth import GroundTruth  # imports torch
            truth = GroundTruth(file, comm)
            try:
                truth.scales
            except ScaleError as error:
                raise SceneError(f"{path}: {error}") from None
            turnover_time = truth.reference["eddy_turnover_time"]
            for problem in _too_many_rollout_steps(scene.simulation, turnover_time) if "simulate" in stages else ():
                raise SceneError(f"{path}: {problem}")
