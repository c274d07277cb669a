"""Whether the sections of a scene fit together: values that are allowed, but not side by side.

Each function yields the problems of one subject in words: what was given, why it cannot be, and what to do.
They run when a scene is made, before any work.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import chain

from eddies.import_path import ImportPathError, load
from eddies.scene.parts import Parts
from eddies.scene.rules import quoted
from eddies.scene.sections import INITIAL_FLOWS, Eulerian, InitialFlow
from eddies.scene.values import import_paths

# What a class of the user's must have, by the key that names it.
REQUIRED = {"fluid": ("nonlinear", "linear", "linear_function", "combine", "compressible"), "kind": ("__call__",),
            "method": ("advance", "frame", "status", "series", "description", "has_density"), "network": ("forward",)}


def first_inconsistency(scene: Parts) -> str | None:
    """The first problem found, or None."""
    subjects = (foreign_problems, flow_problems, initial_problems, time_problems, tracer_problems, section_problems,
                model_problems, density_problems, support_problems, training_problems, simulation_problems,
                grid_problems)
    return next(chain.from_iterable(subject(scene) for subject in subjects), None)


def foreign_problems(scene: Parts) -> Iterator[str]:
    """Import paths that lead nowhere, or to what cannot do what it is named for; those of terms are checked before."""
    sections = {"flow": scene.flow, "initial": scene.initial, "simulation": scene.simulation}
    if scene.model:
        sections |= {f"model.{name}": settings for name, settings in scene.model.settings.items()}
    for section, part in sections.items():
        for key, path in import_paths(part) if part else ():
            try:
                found = load(path)
            except ImportPathError as error:
                yield f"[{section}] {key}: {error}"
                continue
            lacking = [name for name in REQUIRED.get(key, ()) if not hasattr(found, name)]
            if not lacking and key == "network" and not _is_class_of(found, "torch.nn:Module"):
                yield f"[{section}] {key}: {quoted(path)}: must be a class derived from torch.nn.Module"
            if lacking:
                yield f"[{section}] {key}: {quoted(path)}: cannot be used here, it has no {', '.join(lacking)}"


def _is_class_of(found: object, path: str) -> bool:
    """Whether this is a class derived from the one that a path names."""
    return isinstance(found, type) and issubclass(found, load(path))


def flow_problems(scene: Parts) -> Iterator[str]:
    """The fluid and its sound speed; forcing within the resolved scales."""
    flow = scene.flow
    if flow.compressible and flow.sound_speed is None:
        yield "[flow] sound_speed: this key is missing; a compressible fluid needs a number above 0"
    if not flow.compressible and flow.sound_speed is not None:
        yield (f"[flow] sound_speed = {flow.sound_speed:g}: an incompressible fluid has none; remove it or "
               'set fluid = "compressible"')
    if scene.forcing and scene.forcing.wavenumber > flow.cells / 3:
        yield (f"[forcing] wavenumber = {scene.forcing.wavenumber:g}: {flow.cells} cells resolve wavenumbers "
               f"up to {flow.cells / 3:.3g}; lower it or raise [flow] cells")


def initial_problems(scene: Parts) -> Iterator[str]:
    """Keys that only some initial flows read; waves within the resolved scales."""
    initial, defaults = scene.initial, type(scene.initial)()
    if initial.flow.from_file and initial.path is None:
        yield '[initial] path: this key is missing; kind = "file" needs the path of an HDF5 file'
    if initial.flow.sound and not scene.flow.compressible:
        yield '[initial] kind = "sound-wave": needs sound; set [flow] fluid = "compressible"'
    for key in InitialFlow().keys:
        value, kinds = getattr(initial, key), [kind for kind, flow in INITIAL_FLOWS.items() if key in flow.keys]
        if value != getattr(defaults, key) and key not in initial.flow.keys:
            yield (f'[initial] {key} = {value}: only read with kind = {" or ".join(kinds)}, not '
                   f'"{initial.kind}"; remove the key')
    highest = initial.peak_wavenumber if initial.flow.turbulent else initial.wavenumber
    if highest > scene.flow.cells / 3:
        yield (f"[initial] wavenumber {highest:g}: {scene.flow.cells} cells resolve wavenumbers up to "
               f"{scene.flow.cells / 3:.3g}; lower it or raise [flow] cells")


def time_problems(scene: Parts) -> Iterator[str]:
    """One run time, and a forcing that acts in it."""
    duration = scene.time.duration
    if scene.tracers is None and duration is None:
        yield "[time] duration: this key is missing; without [tracers] it is the run time, a number above 0"
    if scene.tracers is not None and duration is not None:
        yield (f"[time] duration = {duration:g}: with [tracers] the run time is [tracers] turnovers; "
               "remove one of the two")
    if scene.spin_up and scene.spin_up.stationary and not (
            scene.forcing and scene.forcing.injection_rate > 0 and scene.flow.viscosity > 0):
        yield (f"[spin_up] stationary = {scene.spin_up.stationary:g}: only a flow with forcing and viscosity becomes "
               "stationary; add [forcing] with an injection_rate above 0 and a viscosity, or remove the key")
    if scene.spin_up and scene.spin_up.stationary and scene.spin_up.stationary >= scene.spin_up.turnovers:
        yield (f"[spin_up] stationary = {scene.spin_up.stationary:g}: must be less than turnovers = "
               f"{scene.spin_up.turnovers:g}, of which they are the last")
    if scene.forcing and scene.tracers and not scene.tracers.forced and scene.spin_up is None:
        yield ("[forcing]: acts only before the tracers start, and there is no [spin_up]; add [spin_up] "
               "turnovers, set [tracers] forced = true, or remove [forcing]")


def tracer_problems(scene: Parts) -> Iterator[str]:
    """Stored fields no finer than the simulation; a flow that moves, and for a model one that changes."""
    tracers, initial = scene.tracers, scene.initial
    if tracers and tracers.forced and scene.forcing is None:
        yield "[tracers] forced = true: there is no [forcing] that could stay on; add it, or remove the key"
    if tracers and initial.flow.sound:
        yield ('[initial] kind = "sound-wave": starts from rest, and [tracers] are followed for turnovers of a flow '
               "that moves; choose another kind, or remove [tracers]")
    if scene.model and initial.flow.steady and scene.flow.viscosity == 0 and scene.forcing is None:
        yield ('[initial] kind = "shear-wave": without viscosity nothing in it is accelerated, and a model is made '
               "dimensionless by the acceleration; choose another kind, or raise [flow] viscosity")
    if tracers and tracers.cells > scene.flow.cells:
        given = "" if tracers.field_cells else " (from particles_per_side)"
        yield (f"[tracers] field_cells = {tracers.cells}{given}: must be at most [flow] cells = "
               f"{scene.flow.cells}; lower field_cells or raise cells")


def section_problems(scene: Parts) -> Iterator[str]:
    """Which sections need which others."""
    needs = {"kernel": ("tracers",), "model": ("tracers",), "training": ("model",), "simulation": ("tracers",)}
    if scene.needs_model:
        needs["simulation"] = ("model",)
    for name, others in needs.items():
        for other in others:
            if getattr(scene, name) is not None and getattr(scene, other) is None:
                yield f"[{name}]: needs a section [{other}], which the scene lacks; add it or remove [{name}]"
    if scene.model and scene.model.path is None and scene.training is None:
        yield ("[model]: needs a section [training], which the scene lacks; add it, give [model] path, a run directory "
               "with trained weights, or remove [model]")


def model_problems(scene: Parts) -> Iterator[str]:
    """Terms that read a density which no term gives, or that give it twice."""
    if scene.model is None:
        return
    settings, gives = scene.model.settings, scene.model.gives
    if {"density", "density_rate"} <= gives:
        first, second = (next(name for name, one in settings.items() if what in one.gives)
                         for what in ("density", "density_rate"))
        yield (f'[model] terms = {quoted(scene.model.terms)}: "{first}" gives the density and "{second}" its rate, '
               "which are two densities; remove one of the two")
    reads = scene.model.reads
    for name, one in settings.items():
        if "density" in one.reads and "density" in one.gives:
            yield f"[model] terms: {quoted(name)}: reads the density and gives a part of it; it can do one of both"
        if "density" not in reads and set(one.gives) <= {"density", "density_rate"}:
            yield (f"[model] terms = {quoted(scene.model.terms)}: {quoted(name)} gives the density alone, which no "
                   "term reads; remove it, or add a term that does")
    if not gives & {"density", "density_rate"}:
        for name, one in settings.items():
            if "density" in one.reads:
                yield (f'[model] terms = {quoted(scene.model.terms)}: "{name}" reads the density, which no term gives; '
                       'add a term that does, such as "pressure" or "continuity", or '
                       f"{_without_density(name, one)}")


def density_problems(scene: Parts) -> Iterator[str]:
    """What reads a density in an incompressible flow, which has none."""
    if scene.flow.compressible:
        return
    remedy = 'or set [flow] fluid = "compressible" and sound_speed'
    for name, one in scene.model.settings.items() if scene.model else ():
        if "density" in one.reads:
            yield (f"[model.{name}]: reads the density, which an incompressible flow does not have; "
                   f"{_without_density(name, one)}, {remedy}")
        if "density_rate" in one.gives:
            yield (f'[model] terms = {quoted(scene.model.terms)}: "{name}" gives a rate of density, which an '
                   f"incompressible flow does not have; remove it, {remedy}")
    if scene.simulation and "density" in scene.simulation.needs:
        yield (f'[simulation] method = "{scene.simulation.method}": starts from the density, which an incompressible '
               f"flow does not have; choose another, {remedy}")


def _without_density(name: str, settings) -> str:
    """How a term does without the density."""
    if "density" in getattr(settings, "inputs", ()):
        return f'leave "density" out of [model.{name}] inputs'
    return f'remove "{name}"'


def support_problems(scene: Parts) -> Iterator[str]:
    """A particle must not see another one and its image: support and skin stay below half the cube."""
    if scene.tracers is None:
        return
    skin = scene.simulation.skin if scene.simulation else 0.0
    for section, part in (("kernel", scene.kernel), ("model", scene.model)):
        neighbors = part.neighbors if part else None
        reach = 0.0 if neighbors is None else scene.tracers.radius_of(neighbors) * (1 + skin)
        if reach >= math.pi:
            yield (f"[{section}] neighbors = {neighbors:g}: {scene.tracers.particles} particles "
                   f"reach {reach:.3g} with the skin, and half the cube is {math.pi:.3g}; lower neighbors or "
                   "raise [tracers] particles_per_side")


def training_problems(scene: Parts) -> Iterator[str]:
    """Steps, rates and weights that contradict each other."""
    training = scene.training
    if training is None:
        return
    if training.combined_steps > training.steps:
        yield (f"[training] combined_steps = {training.combined_steps}: must be at most steps = "
               f"{training.steps}, of which they are the last")
    if training.final_learning_rate > training.learning_rate:
        yield (f"[training] final_learning_rate = {training.final_learning_rate:g}: must be at most "
               f"learning_rate = {training.learning_rate:g}")
    if (horizons := training.horizons) is not None:
        step, interval = horizons.time_step, scene.tracers.frame_interval if scene.tracers else None
        if step and interval and not _is_multiple(interval, step):
            yield (f"[training.horizons] time_step = {step:g}: [tracers] frame_interval = {interval:g} must be a whole "
                   "multiple of it; change either")
        if training.final_learning_rate > horizons.learning_rate:
            yield (f"[training] final_learning_rate = {training.final_learning_rate:g}: must be at most "
                   f"[training.horizons] learning_rate = {horizons.learning_rate:g}")
    if training.truths is not None and not training.truths:
        yield "[training] truths = []: must name one or more run directories; name them, or remove the key"
    if training.frames < 2 * len(training.truths or ()):
        yield (f"[training] frames = {training.frames}: the {len(training.truths)} truths need 2 each, "
               f"{2 * len(training.truths)} in all; raise it")
    if scene.tracers and training.batch > scene.tracers.particles:
        yield (f"[training] batch = {training.batch}: must be at most the number of particles, "
               f"{scene.tracers.particles}; lower it or raise [tracers] particles_per_side")
    if training.field_weight > 0 and scene.kernel is None:
        yield (f"[training] field_weight = {training.field_weight:g}: this loss is an average with the kernel; add "
               "[kernel], or remove the key")
    if training.field_target == "flow" and training.field_weight == 0:
        yield ('[training] field_target = "flow": is of the field loss, which has no weight; set field_weight, or '
               "remove the key")
    later = training.field_weight + training.velocity_kl_weight + training.acceleration_kl_weight
    if (later > 0) != (training.combined_steps > 0):
        yield (f"[training] combined_steps = {training.combined_steps}: they are the steps that use "
               "field_weight, velocity_kl_weight and acceleration_kl_weight; give both the steps and a "
               "weight above 0, or neither")


def simulation_problems(scene: Parts) -> Iterator[str]:
    """Frames that fall on the frames of the ground truth, and on steps or between those that tell what is there."""
    simulation = scene.simulation
    if simulation is None or scene.tracers is None:
        return
    frame = simulation.frame_interval
    step = simulation.longest_step
    if not simulation.scheme.dense and math.isfinite(step) and not _is_multiple(frame, step):
        yield (f"[simulation] frame_interval = {frame:g}: must be a whole multiple of step = "
               f'{step:g} with integrator = "{simulation.integrator}", which does not tell what is between '
               "steps; change any")
    if not _is_multiple(frame, scene.tracers.frame_interval):
        yield (f"[simulation] frame_interval = {frame:g}: must be a whole multiple of [tracers] "
               f"frame_interval = {scene.tracers.frame_interval:g}, so that truth and model are stored at "
               "the same times")
    if simulation.start is None and scene.seen_in(scene.directory) == 1:
        yield ("[simulation] start: this key is missing; the training window is the whole ground truth, so "
               "there is nothing after it; give start, or a smaller [training] window")


def grid_problems(scene: Parts) -> Iterator[str]:
    """[eulerian] of another method; a coarse grid finer than what it starts from, or that takes what is not there."""
    simulation = scene.simulation
    if scene.eulerian is not None and (simulation is None or not simulation.on_grid):
        yield '[eulerian]: only read with [simulation] method = "eulerian"; set it, or remove [eulerian]'
    if simulation and simulation.on_grid:
        eulerian = scene.eulerian or Eulerian()
        cells = eulerian.cells_for(scene.tracers.filter_width)
        if cells > scene.flow.cells:
            yield (f"[eulerian] cells = {cells}: must be at most the {scene.flow.cells} of the flow that it starts "
                   "from; lower cells")
        if eulerian.form.learned and not scene.model.damping:
            yield ('[eulerian] closure = "learned": takes the rates of the term "damping", which [model] has not; add '
                   "it to its terms, or choose another closure")
        if eulerian.compressible and not scene.flow.compressible:
            yield ('[eulerian] fluid = "compressible": [flow] fluid is incompressible and has no sound speed; set both '
                   "to the same")


def _is_multiple(interval: float, unit: float) -> bool:
    ratio = interval / unit
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-9 * ratio
