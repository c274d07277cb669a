"""The cross-checks of a scene. They find values that are allowed on their own, but not together.

The checks run when a scene is made. Each check compares some sections and yields its problems. A problem is a pair of
the key at fault, "section.key", and a text with the reason and a remedy.
"""

import math
import re
from collections.abc import Collection, Iterable, Iterator, Sequence

from eddies.import_path import ImportPathError, is_path, load
from eddies.pipeline import STAGES
from eddies.scene.model import Model
from eddies.scene.sections import (INITIAL_FLOWS, Eulerian, Flow, Forcing, Initial, InitialFlow, Kernel, Simulation,
                                   SpinUp, Time, Tracers, Training)

Problems = Iterator[tuple[str, str]]

# Attributes that a user's class must have, by the key that names the class.
REQUIRED = {"flow.fluid": ("nonlinear", "linear", "linear_function", "combine", "compressible"),
            "initial.kind": ("__call__",),
            "simulation.method": ("advance", "frame", "status", "series", "description", "has_density")}
# Reserved names in a run directory, besides the products and checkpoint directories of the stages.
RESERVED = ("report", "vtkhdf", "lagrangebench", "STOP", "LOCK")
REALISATION = "realisation-"
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{,99}"
# Keys that must have the same value in a variant and in the scene, each with the reason. For the keys of STARTS this
# holds only if rollouts start after the training window.
SAME_TIMES = "all variants start at the same moment and are compared at the same times; change it for the whole scene"
SAME_START = ("rollouts start after the training window, and all must start at the same moment; give the scene a "
              "[simulation] start")
COMPARED = {**dict.fromkeys(("simulation.turnovers", "simulation.start", "simulation.frame_interval"), SAME_TIMES),
            "kernel.form": "all variants are measured alike; change it for the whole scene"}
STARTS = dict.fromkeys(("training.window", "training.truths"), SAME_START)


def check_names(name: str, seed: int, realisations: Sequence[int], has_rollouts: bool) -> Problems:
    """Yield a problem if the name of a scene cannot be that of a directory, or if seeds of realisations are not used,
    repeated, or equal to the seed of the scene."""
    if not re.fullmatch(NAME, name):
        yield "name", ('must be the name of a directory: at most 100 letters, digits, ".", "_" and "-", the first a '
                       'letter or a digit; choose another, such as "my-run_2"')
    if realisations and not has_rollouts:
        yield "realisations", "the scene has no [simulation], so no rollout uses them; add it, or remove the key"
    for other in realisations:
        if realisations.count(other) > 1:
            yield "realisations", f"{other} is given more than once; name each seed once"
        if other == seed:
            yield "realisations", (f"{other} is the seed of the scene, and models are trained on its ground truth; "
                                   "leave this seed out")


def problem_of_name(variant: str) -> str:
    """Return the problem with the name of a variant or of a set of tracers; empty if the name is valid."""
    if not re.fullmatch(NAME, variant) or "." in variant:
        return 'a name has at most 100 letters, digits, "_" and "-", the first a letter or a digit; choose another'
    reserved = {*RESERVED, *(name for stage in STAGES.values() for name in (stage.product, stage.checkpoints))}
    if variant in reserved or variant.startswith(REALISATION):
        return "a run directory uses this name for something else; choose another"
    return ""


def check_foreign(paths: Iterable[tuple[str, str]]) -> Problems:
    """Yield a problem for each import path that cannot be loaded, or whose class does not fit its key.

    `paths` are pairs (key, import path). `Model` checks the classes of terms further.
    """
    for key, path in paths:
        try:
            found = load(path)
        except ImportPathError as error:
            yield key, str(error).partition(": ")[2]
            continue
        lacking = [name for name in REQUIRED.get(key, ()) if not hasattr(found, name)]
        if lacking:
            yield key, f"cannot be used here, because it has no {', '.join(lacking)}; add it"
        elif key.endswith(".network") and not (
                isinstance(found, type) and issubclass(found, load("torch.nn:Module"))):
            yield key, "must be a class derived from torch.nn.Module"


def check_flow(flow: Flow, initial: Initial, forcing: Forcing | None, model: Model | None) -> Problems:
    """Yield a problem if the sound speed or a key of [initial] does not fit the flow, or if a wavenumber is too high
    for the grid."""
    if flow.compressible and flow.sound_speed is None:
        yield "flow.sound_speed", "this key is missing; a compressible fluid needs a number above 0"
    if not flow.compressible and flow.sound_speed is not None:
        yield "flow.sound_speed", 'an incompressible fluid has none; remove it or set fluid = "compressible"'
    if "path" in initial.flow.keys and initial.path is None and not is_path(initial.kind):
        wanted = "an HDF5 file" if initial.flow.from_file else "a text file"
        yield "initial.path", f'this key is missing; kind = "{initial.kind}" needs the path of {wanted}'
    if initial.flow.sound and not flow.compressible:
        yield "initial.kind", 'sound needs a compressible fluid; set [flow] fluid = "compressible"'
    if model and initial.flow.steady and flow.viscosity == 0 and forcing is None:
        yield "initial.kind", ("without viscosity this flow has no acceleration, which is the unit of a model's "
                               "forces; choose another kind, or raise [flow] viscosity")
    for key in InitialFlow().keys:
        if key not in initial.flow.keys and getattr(initial, key) != type(initial).__dataclass_fields__[key].default:
            kinds = [kind for kind, each in INITIAL_FLOWS.items() if key in each.keys]
            yield f"initial.{key}", f'only read with kind = {" or ".join(kinds)}, not "{initial.kind}"; remove the key'
    waves = {"initial.peak_wavenumber": initial.peak_wavenumber if initial.flow.turbulent else 0,
             "initial.wavenumber": 0 if initial.flow.turbulent else initial.wavenumber,
             "forcing.wavenumber": forcing.wavenumber if forcing else 0}
    for key, wavenumber in waves.items():
        if wavenumber > flow.cells / 3:
            yield key, (f"{flow.cells} cells resolve wavenumbers up to {flow.cells / 3:.3g}; lower it or raise [flow] "
                        "cells")


def check_time(time: Time, flow: Flow, forcing: Forcing | None, spin_up: SpinUp | None,
               tracers: Tracers | None) -> Problems:
    """Yield a problem if the run time is missing or given twice, if the stationary span does not fit the flow or the
    spin-up, or if forcing never acts or is missing."""
    if tracers is None and time.duration is None:
        yield "time.duration", "this key is missing; without [tracers] it is the run time, a number above 0"
    if tracers is not None and time.duration is not None:
        yield "time.duration", "with [tracers] the run time is [tracers] turnovers; remove this key, or [tracers]"
    if spin_up and spin_up.stationary:
        if not (forcing and forcing.injection_rate > 0 and flow.viscosity > 0):
            yield "spin_up.stationary", ("only a flow with forcing and viscosity becomes stationary; add [forcing] "
                                         "with an injection_rate above 0 and a viscosity, or remove the key")
        if spin_up.stationary >= spin_up.turnovers:
            yield "spin_up.stationary", (f"must be less than turnovers = {spin_up.turnovers:g}, because the stationary "
                                         "span is the last part of the spin-up; lower it")
    if forcing and tracers and not tracers.forced and spin_up is None:
        yield "forcing", ("acts only before the tracers start, and there is no [spin_up]; add [spin_up] turnovers, set "
                          "[tracers] forced = true, or remove [forcing]")
    if tracers and tracers.forced and forcing is None:
        yield "tracers.forced", "needs a section [forcing], which the scene lacks; add it, or remove the key"


def check_tracers(tracers: Tracers, flow: Flow, initial: Initial, variants: Collection[str]) -> Problems:
    """Yield a problem if the flow starts from rest, if the name of a set of tracers is invalid, or if a filtered field
    has more cells than the flow."""
    if initial.flow.sound:
        yield "initial.kind", ("starts from rest and has no turnover time, the unit of [tracers] turnovers; choose "
                               "another kind, or remove [tracers]")
    for name, each in (tracers.sets or {"": tracers}).items():
        problem = name and (problem_of_name(name) or name in variants and "a variant has this name; choose another")
        if problem:
            yield "tracers", f"set {name}: {problem}"
        if each.cells > flow.cells:
            key = f"set {name}: field_cells " if name else ""
            default = "" if each.field_cells else f"is {each.cells} (from particles_per_side) and "
            yield f"tracers{'' if name else '.field_cells'}", (
                f"{key}{default}must be at most [flow] cells = {flow.cells}; lower field_cells or raise cells")


def check_particles(tracers: Tracers, kernel: Kernel | None, model: Model | None, simulation: Simulation | None,
                    present: Collection[str]) -> Problems:
    """Yield a problem if tracers follow the unfiltered velocity in a scene with a kernel, a model or a rollout, or if
    the radius within which particles are neighbours, with the skin, is at least half the edge of the cube.

    `present` holds the names of the sections that the scene has.
    """
    made = [f"[{name}]" for name in ("kernel", "model", "training", "simulation") if name in present]
    if not tracers.filtered and made:
        yield "tracers.filtered", ("these particles follow the unfiltered velocity, but kernels, models and rollouts "
                                   "need the filtered one; set it to true, choose another set of tracers, or "
                                   f"remove {', '.join(made)}")
    for name, section in (("kernel", kernel), ("model", model)):
        neighbors = section.neighbors if section else None
        reach = tracers.radius_of(neighbors or 0.0) * (1 + (simulation.skin if simulation else 0.0))
        if reach >= math.pi:  # a particle could interact with two periodic images of another one
            yield f"{name}.neighbors", (
                f"with {tracers.particles} particles radius and skin together are {reach:.3g}, but must be less than "
                f"half the cube, {math.pi:.3g}; lower neighbors to less than {neighbors * (math.pi / reach)**3:.3g} "
                "or raise [tracers] particles_per_side")


def check_needs(present: Collection[str], needs_model: bool, has_weights: bool) -> Problems:
    """Yield a problem for each section that needs a section which the scene lacks.

    `present` holds the names of the sections that the scene has. `needs_model` is true if the rollout needs a trained
    model, `has_weights` if [model] path gives trained weights.
    """
    needs = {"kernel": "tracers", "reconstruction": "tracers", "model": "tracers", "training": "model",
             "simulation": "model" if needs_model else "tracers"}
    for name, other in needs.items():
        if name in present and other not in present:
            yield name, f"needs a section [{other}], which the scene lacks; add it or remove [{name}]"
    if "model" in present and not has_weights and "training" not in present:
        yield "model", ("needs a section [training], which the scene lacks; add it, give [model] path, a run directory "
                        "with trained weights, or remove [model]")


def check_density(flow: Flow, model: Model | None, simulation: Simulation | None) -> Problems:
    """Yield a problem if terms give the density twice, if no term reads the density that a term gives, if no term gives
    the density that a term reads, or if one term both reads and gives it. Yield a problem, too, if a term or the method
    of the rollout needs the density of an incompressible flow."""
    incompressible, rates = not flow.compressible, {"density", "density_rate"}
    remedy = 'or set [flow] fluid = "compressible" and sound_speed'
    settings = model.settings if model else {}
    reads, gives = (model.reads, model.gives) if model else (set(), set())
    if rates <= gives:
        first, second = (next(name for name, one in settings.items() if kind in one.gives)
                         for kind in ("density", "density_rate"))
        yield "model.terms", (f'"{first}" gives the density and "{second}" gives its rate, so it is given twice; '
                              "remove one of the two")
    for name, one in settings.items():
        leave = (f'leave "density" out of [model.{name}] inputs' if "density" in getattr(one, "inputs", ()) else
                 f'remove "{name}"')
        if "density" in one.reads and "density" in one.gives:
            yield "model.terms", f'"{name}" both reads and gives the density; it can do only one of the two'
        if "density" not in reads and rates >= {*one.gives}:
            yield "model.terms", (f'"{name}" gives only the density, which no term reads; remove this term, or add '
                                  "one that reads the density")
        if "density" in one.reads and not rates & gives:
            yield "model.terms", (f'"{name}" reads the density, which no term gives; add one that gives it, such as '
                                  f'"pressure" or "continuity", or {leave}')
        if "density" in one.reads and incompressible:
            yield f"model.{name}", f"reads the density, which an incompressible flow does not have; {leave}, {remedy}"
        if "density_rate" in one.gives and incompressible:
            yield "model.terms", (f'"{name}" gives a rate of density, which an incompressible flow does not have; '
                                  f"remove it, {remedy}")
    if simulation and "density" in simulation.form.needs and incompressible:
        yield "simulation.method", ("needs the density, which an incompressible flow does not have; choose "
                                    f"another, {remedy}")


def check_training(training: Training, tracers: Tracers | None, kernel: Kernel | None) -> Problems:
    """Yield a problem if the numbers of steps, frames and particles, the learning rates or the weights of the training
    contradict each other or other sections."""
    if training.combined_steps > training.steps:
        yield "training.combined_steps", (f"must be at most steps = {training.steps}, because the combined steps are "
                                          "the last of all steps; lower it")
    for section, part in {"": training, "[training.horizons] ": training.horizons}.items():
        if part is not None and training.final_learning_rate > part.learning_rate:
            yield "training.final_learning_rate", f"must be at most {section}learning_rate = {part.learning_rate:g}"
    step = training.horizons and training.horizons.time_step
    if step and tracers and not _is_multiple(tracers.frame_interval, step):
        yield "training.horizons.time_step", (f"[tracers] frame_interval = {tracers.frame_interval:g} must be a whole "
                                              "multiple of it; change either")
    truths = training.truths
    if truths == ():
        yield "training.truths", "is empty; name one or more run directories, or remove the key"
    if truths and training.frames < 2 * len(truths):
        yield "training.frames", f"the {len(truths)} truths need 2 frames each, {2 * len(truths)} in all; raise it"
    if tracers and training.batch > tracers.particles:
        yield "training.batch", (f"must be at most the number of particles, {tracers.particles}; lower it or raise "
                                 "[tracers] particles_per_side")
    if training.field_weight > 0 and kernel is None:
        yield "training.field_weight", "this loss needs a section [kernel], which is missing; add it, or remove the key"
    if training.field_target == "flow" and training.field_weight == 0:
        yield "training.field_target", ("applies to the field loss, whose weight is 0; set field_weight, or remove the "
                                        "key")
    later = training.field_weight + training.velocity_kl_weight + training.acceleration_kl_weight
    if (later > 0) != (training.combined_steps > 0):
        yield "training.combined_steps", (
            "only these steps use field_weight, velocity_kl_weight and acceleration_kl_weight; set both the steps and "
            "a weight above 0, or neither")


def check_simulation(simulation: Simulation, tracers: Tracers, seen: float) -> Problems:
    """Yield a problem if the frame interval is not a whole multiple of the tracers' frame interval; if it is not one of
    the step, and the integrator gives no values between steps; or if `start` is missing, and training uses the whole
    ground truth.

    `seen` is the fraction of the ground truth that training uses.
    """
    step, frame_interval = simulation.longest_step, simulation.frame_interval
    if not (simulation.scheme.dense or math.isinf(step) or _is_multiple(frame_interval, step)):
        yield "simulation.frame_interval", (
            f'must be a whole multiple of step = {step:g} with integrator = "{simulation.integrator}", which gives no '
            "values between steps; change one of the three")
    if not _is_multiple(frame_interval, tracers.frame_interval):
        yield "simulation.frame_interval", (
            f"must be a whole multiple of [tracers] frame_interval = {tracers.frame_interval:g}, so that truth and "
            "model are stored at the same times")
    if simulation.start is None and seen == 1:
        yield "simulation.start", ("this key is missing; the training window is the whole ground truth, so the rollout "
                                   "cannot start after it; give start, or a smaller [training] window")


def check_coarse_grid(eulerian: Eulerian | None, cells: int, flow: Flow, model: Model | None) -> Problems:
    """Yield a problem if [eulerian] is not used, if its grid is too fine, or if the sound speed or the damping rates
    that it needs are missing.

    `cells` is the number of cells along a side of this grid; 0 if the rollout has no such grid. It may exceed the
    number of cells of the flow only with start = "particles".
    """
    if eulerian is None:
        eulerian = Eulerian()
    elif not cells:
        yield "eulerian", 'only read with [simulation] method = "eulerian"; set it, or remove [eulerian]'
    if cells > flow.cells and eulerian.start != "particles":
        yield "eulerian.cells", (f"must be at most [flow] cells = {flow.cells}, because the coarse grid starts from "
                                 "that flow; lower it")
    if eulerian.form.learned and model and not model.damping:
        yield "eulerian.closure", ('needs the rates of the term "damping", which [model] lacks; add this term to '
                                   "its terms, or choose another closure")
    if eulerian.compressible and not flow.compressible:
        yield "eulerian.fluid", "[flow] fluid is incompressible and gives no sound speed; set both to the same fluid"


def _is_multiple(interval: float, unit: float) -> bool:
    ratio = interval / unit
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-9 * ratio
