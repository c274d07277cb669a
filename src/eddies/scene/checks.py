"""The cross-checks of a scene: values that are allowed alone, but not side by side.

`problems` compares all sections with each other when a scene is made, before any work. Each check yields the key at
fault, "section.key", and in words the reason and a remedy.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from itertools import chain
from typing import Any

from eddies.import_path import ImportPathError, load
from eddies.pipeline import STAGES
from eddies.scene.layers import VARIANT
from eddies.scene.parts import Parts
from eddies.scene.rules import quoted
from eddies.scene.sections import INITIAL_FLOWS, Eulerian, InitialFlow
from eddies.scene.values import SceneError, Section, import_paths, place

Problems = Iterator[tuple[str, str]]

# The attributes that a class of the user's must have, by the key that names it.
REQUIRED = {"fluid": ("nonlinear", "linear", "linear_function", "combine", "compressible"), "kind": ("__call__",),
            "method": ("advance", "frame", "status", "series", "description", "has_density"), "network": ("forward",)}
# The keys of a scene that a variant cannot change.
OF_THE_WHOLE = ("name", "base", "realisations", VARIANT)
# Other names in a run directory, beside the products and directories of the stages.
RESERVED = ("report", "vtkhdf", "lagrangebench", "STOP", "LOCK")
REALISATION = "realisation-"
NAME = r"[A-Za-z0-9][A-Za-z0-9._-]{,99}"


def problems(scene: Parts) -> Iterator[SceneError]:
    """Yield the problems of a scene: in its names, of its sections side by side, of its variants."""
    checks = (check_names, check_foreign, check_flow, check_time, check_tracers, check_needs, check_density,
              check_training, check_simulation, check_coarse_grid, check_variants)
    for key, problem in chain.from_iterable(check(scene) for check in checks):
        yield SceneError(f"{given(scene, key)}: {problem}", key)


def given(scene: Parts, key: str) -> str:
    """Return a key and its value as an error begins: "[flow] cells = 8"; without the value where there is none."""
    section, _, name = key.rpartition(".")
    value: Any = scene
    for part in key.split("."):
        value = getattr(value, part, None)
    if section == VARIANT:
        return f'variant "{name}"'
    if isinstance(value, Section) or section == "model" and not hasattr(scene.model, name):
        return f"[{key}]"
    if value is None:
        return place(name, section)
    return f"{place(name, section)} = {f'{value:g}' if isinstance(value, float) else quoted(value)}"


def check_names(scene: Parts) -> Problems:
    """The name of a directory, and seeds of realisations that are different."""
    if not re.fullmatch(NAME, scene.name):
        yield "name", ('must be the name of a directory: at most 100 letters, digits, ".", "_" and "-", the first a '
                       'letter or a digit; choose another, such as "my-run_2"')
    if scene.realisations and scene.simulation is None and not scene.variant:
        yield "realisations", "the scene has no [simulation] to make rollouts on them; add it, or remove the key"
    for seed in scene.realisations or ():
        if scene.realisations.count(seed) > 1:
            yield "realisations", f"{seed} is there more than once; name each seed once"
        if seed == scene.seed:
            yield "realisations", (f"{seed} is the seed of the scene, whose ground truth models are trained on; leave "
                                   "it out")


def check_foreign(scene: Parts) -> Problems:
    """Import paths that lead nowhere, or to a class without what its key needs; [model] checks those of terms."""
    sections: dict[str, Section | None] = {"flow": scene.flow, "initial": scene.initial, "simulation": scene.simulation}
    if scene.model:
        sections |= {f"model.{name}": settings for name, settings in scene.model.settings.items()}
    for section, part in sections.items():
        for key, path in import_paths(part) if part else ():
            try:
                found = load(path)
            except ImportPathError as error:
                yield f"{section}.{key}", str(error).partition(": ")[2]
                continue
            lacking = [name for name in REQUIRED.get(key, ()) if not hasattr(found, name)]
            if lacking:
                yield f"{section}.{key}", f"cannot be used here, it has no {', '.join(lacking)}"
            elif key == "network" and not (isinstance(found, type) and issubclass(found, load("torch.nn:Module"))):
                yield f"{section}.{key}", "must be a class derived from torch.nn.Module"


def check_flow(scene: Parts) -> Problems:
    """The sound speed, keys that only some initial flows read, and waves within the resolved scales."""
    flow, initial = scene.flow, scene.initial
    if flow.compressible and flow.sound_speed is None:
        yield "flow.sound_speed", "this key is missing; a compressible fluid needs a number above 0"
    if not flow.compressible and flow.sound_speed is not None:
        yield "flow.sound_speed", 'an incompressible fluid has none; remove it or set fluid = "compressible"'
    if initial.flow.from_file and initial.path is None:
        yield "initial.path", 'this key is missing; kind = "file" needs the path of an HDF5 file'
    if initial.flow.sound and not flow.compressible:
        yield "initial.kind", 'needs sound; set [flow] fluid = "compressible"'
    if scene.model and initial.flow.steady and flow.viscosity == 0 and scene.forcing is None:
        yield "initial.kind", ("without viscosity nothing in it is accelerated, and a model is made dimensionless by "
                               "the acceleration; choose another kind, or raise [flow] viscosity")
    for key in InitialFlow().keys:
        if key not in initial.flow.keys and getattr(initial, key) != type(initial).__dataclass_fields__[key].default:
            kinds = [kind for kind, each in INITIAL_FLOWS.items() if key in each.keys]
            yield f"initial.{key}", f'only read with kind = {" or ".join(kinds)}, not "{initial.kind}"; remove the key'
    waves = {"initial.peak_wavenumber": initial.peak_wavenumber if initial.flow.turbulent else 0,
             "initial.wavenumber": 0 if initial.flow.turbulent else initial.wavenumber,
             "forcing.wavenumber": scene.forcing.wavenumber if scene.forcing else 0}
    for key, wavenumber in waves.items():
        if wavenumber > flow.cells / 3:
            yield key, (f"{flow.cells} cells resolve wavenumbers up to {flow.cells / 3:.3g}; lower it or raise [flow] "
                        "cells")


def check_time(scene: Parts) -> Problems:
    """One run time, and a forcing that acts in it."""
    spin_up, forcing, tracers = scene.spin_up, scene.forcing, scene.tracers
    if tracers is None and scene.time.duration is None:
        yield "time.duration", "this key is missing; without [tracers] it is the run time, a number above 0"
    if tracers is not None and scene.time.duration is not None:
        yield "time.duration", "with [tracers] the run time is [tracers] turnovers; remove one of the two"
    if spin_up and spin_up.stationary:
        if not (forcing and forcing.injection_rate > 0 and scene.flow.viscosity > 0):
            yield "spin_up.stationary", ("only a flow with forcing and viscosity becomes stationary; add [forcing] "
                                         "with an injection_rate above 0 and a viscosity, or remove the key")
        if spin_up.stationary >= spin_up.turnovers:
            yield "spin_up.stationary", (f"must be less than turnovers = {spin_up.turnovers:g}, of which they are the "
                                         "last")
    if forcing and tracers and not tracers.forced and spin_up is None:
        yield "forcing", ("acts only before the tracers start, and there is no [spin_up]; add [spin_up] turnovers, set "
                          "[tracers] forced = true, or remove [forcing]")
    if tracers and tracers.forced and forcing is None:
        yield "tracers.forced", "there is no [forcing] that could stay on; add it, or remove the key"


def check_tracers(scene: Parts) -> Problems:
    """A flow that moves the tracers, fields no finer than the flow, and supports that end below half the cube."""
    tracers = scene.tracers
    if tracers is None:
        return
    if scene.initial.flow.sound:
        yield "initial.kind", ("starts from rest, and [tracers] are followed for turnovers of a flow that moves; "
                               "choose another kind, or remove [tracers]")
    if tracers.cells > scene.flow.cells:
        default = "" if tracers.field_cells else f"is {tracers.cells} (from particles_per_side) and "
        yield "tracers.field_cells", (f"{default}must be at most [flow] cells = {scene.flow.cells}; lower field_cells "
                                      "or raise cells")
    skin = scene.simulation.skin if scene.simulation else 0.0
    for section, part in (("kernel", scene.kernel), ("model", scene.model)):
        reach = tracers.radius_of(part.neighbors) * (1 + skin) if part and part.neighbors else 0.0
        if reach >= math.pi:  # a particle would see another one and its image
            yield f"{section}.neighbors", (
                f"{tracers.particles} particles reach {reach:.3g} with the skin, and half the cube is {math.pi:.3g}; "
                "lower neighbors or raise [tracers] particles_per_side")


def check_needs(scene: Parts) -> Problems:
    """Sections that need others."""
    needs = {"kernel": "tracers", "model": "tracers", "training": "model",
             "simulation": "model" if scene.needs_model else "tracers"}
    for name, other in needs.items():
        if getattr(scene, name) is not None and getattr(scene, other) is None:
            yield name, f"needs a section [{other}], which the scene lacks; add it or remove [{name}]"
    if scene.model and scene.model.path is None and scene.training is None:
        yield "model", ("needs a section [training], which the scene lacks; add it, give [model] path, a run directory "
                        "with trained weights, or remove [model]")


def check_density(scene: Parts) -> Problems:
    """A density that is given twice, or that is read where the terms or the flow give none."""
    incompressible, rates = not scene.flow.compressible, {"density", "density_rate"}
    remedy = 'or set [flow] fluid = "compressible" and sound_speed'
    settings = scene.model.settings if scene.model else {}
    reads, gives = (scene.model.reads, scene.model.gives) if scene.model else ({"density"}, rates)
    if settings and rates <= gives:
        first, second = (next(name for name, one in settings.items() if kind in one.gives)
                         for kind in ("density", "density_rate"))
        yield "model.terms", (f'"{first}" gives the density and "{second}" its rate, which are two densities; remove '
                              "one of the two")
    for name, one in settings.items():
        leave = (f'leave "density" out of [model.{name}] inputs' if "density" in getattr(one, "inputs", ()) else
                 f'remove "{name}"')
        if "density" in one.reads and "density" in one.gives:
            yield "model.terms", f'"{name}" reads the density and gives a part of it; it can do one of both'
        if "density" not in reads and rates >= {*one.gives}:
            yield "model.terms", (f'"{name}" gives the density alone, which no term reads; remove it, or add a term '
                                  "that does")
        if "density" in one.reads and not rates & gives:
            yield "model.terms", (f'"{name}" reads the density, which no term gives; add a term that does, such as '
                                  f'"pressure" or "continuity", or {leave}')
        if "density" in one.reads and incompressible:
            yield f"model.{name}", f"reads the density, which an incompressible flow does not have; {leave}, {remedy}"
        if "density_rate" in one.gives and incompressible:
            yield "model.terms", (f'"{name}" gives a rate of density, which an incompressible flow does not have; '
                                  f"remove it, {remedy}")
    if scene.simulation and "density" in scene.simulation.needs and incompressible:
        yield "simulation.method", ("starts from the density, which an incompressible flow does not have; choose "
                                    f"another, {remedy}")


def check_training(scene: Parts) -> Problems:
    """Steps, rates and weights that contradict each other."""
    training, tracers = scene.training, scene.tracers
    if training is None:
        return
    if training.combined_steps > training.steps:
        yield "training.combined_steps", f"must be at most steps = {training.steps}, of which they are the last"
    for section, part in {"": training, "[training.horizons] ": training.horizons}.items():
        if part is not None and training.final_learning_rate > part.learning_rate:
            yield "training.final_learning_rate", f"must be at most {section}learning_rate = {part.learning_rate:g}"
    step = training.horizons and training.horizons.time_step
    if step and tracers and not _is_multiple(tracers.frame_interval, step):
        yield "training.horizons.time_step", (f"[tracers] frame_interval = {tracers.frame_interval:g} must be a whole "
                                              "multiple of it; change either")
    truths = training.truths
    if truths == ():
        yield "training.truths", "must name one or more run directories; name them, or remove the key"
    if truths and training.frames < 2 * len(truths):
        yield "training.frames", f"the {len(truths)} truths need 2 each, {2 * len(truths)} in all; raise it"
    if tracers and training.batch > tracers.particles:
        yield "training.batch", (f"must be at most the number of particles, {tracers.particles}; lower it or raise "
                                 "[tracers] particles_per_side")
    if training.field_weight > 0 and scene.kernel is None:
        yield "training.field_weight", "this loss is an average with the kernel; add [kernel], or remove the key"
    if training.field_target == "flow" and training.field_weight == 0:
        yield "training.field_target", "is of the field loss, which has no weight; set field_weight, or remove the key"
    later = training.field_weight + training.velocity_kl_weight + training.acceleration_kl_weight
    if (later > 0) != (training.combined_steps > 0):
        yield "training.combined_steps", (
            "they are the steps that use field_weight, velocity_kl_weight and acceleration_kl_weight; give both the "
            "steps and a weight above 0, or neither")


def check_simulation(scene: Parts) -> Problems:
    """Frames at the times of the ground truth and of steps, and a start within the ground truth."""
    simulation, tracers = scene.simulation, scene.tracers
    if simulation is None or tracers is None:
        return
    step, frame_interval = simulation.longest_step, simulation.frame_interval
    if not (simulation.scheme.dense or math.isinf(step) or _is_multiple(frame_interval, step)):
        yield "simulation.frame_interval", (
            f'must be a whole multiple of step = {step:g} with integrator = "{simulation.integrator}", which gives no '
            "values between steps; change any")
    if not _is_multiple(frame_interval, tracers.frame_interval):
        yield "simulation.frame_interval", (
            f"must be a whole multiple of [tracers] frame_interval = {tracers.frame_interval:g}, so that truth and "
            "model are stored at the same times")
    if simulation.start is None and scene.seen_in(scene.directory) == 1:
        yield "simulation.start", ("this key is missing; the training window is the whole ground truth, so there is "
                                   "nothing after it; give start, or a smaller [training] window")


def check_coarse_grid(scene: Parts) -> Problems:
    """A coarse grid of its own method, no finer than the flow, and with what its fluid and closure need."""
    simulation, flow = scene.simulation, scene.flow
    if simulation is None or not simulation.on_grid:
        if scene.eulerian is not None:
            yield "eulerian", 'only read with [simulation] method = "eulerian"; set it, or remove [eulerian]'
        return
    eulerian = scene.eulerian or Eulerian()
    if scene.tracers and eulerian.cells_for(scene.tracers.filter_width) > flow.cells:
        yield "eulerian.cells", f"must be at most the {flow.cells} of the flow that it starts from; lower cells"
    if eulerian.form.learned and scene.model and not scene.model.damping:
        yield "eulerian.closure", ('takes the rates of the term "damping", which [model] lacks; add it to its terms, '
                                   "or choose another closure")
    if eulerian.compressible and not flow.compressible:
        yield "eulerian.fluid", "[flow] fluid is incompressible and has no sound speed; set both to the same"


def check_variants(scene: Parts) -> Problems:
    """Variants that cannot be run beside each other, or whose rollouts cannot be compared."""
    reserved = {*RESERVED, *(name for stage in STAGES.values() for name in (stage.product, stage.checkpoints))}
    for name, variant in scene.variant.items():
        key = f"{VARIANT}.{name}"
        if not re.fullmatch(NAME, name) or "." in name:
            yield key, ('a name has at most 100 letters, digits, "_" and "-", the first a letter or a digit; choose '
                        "another")
        elif name in reserved or name.startswith(REALISATION):
            yield key, "a run directory uses this name for something else; choose another"
        elif not isinstance(variant, type(scene)) or variant.variant or variant.realisations:
            yield key, "must be a scene without variants and realisations of its own"
        elif variant.simulation is None or scene.simulation is None:
            yield key, "variants are compared by their rollouts; add [simulation] to the scene and to its variants"
        else:
            yield from ((key, problem) for problem in _different_comparison(scene, variant))


def _different_comparison(scene: Parts, variant: Parts) -> Iterator[str]:
    """Keys of the start, the times and the measures of rollouts that differ between a variant and the scene."""
    same = "all variants start at the same moment and are compared at the same times; change it for the whole scene"
    start = "rollouts start after it, and all must start at the same moment; give the scene a [simulation] start"
    reasons = {"simulation.turnovers": same, "simulation.start": same, "simulation.frame_interval": same,
               "kernel.form": "all variants are measured alike; change it for the whole scene"}
    if scene.realisations is None and variant.simulation and variant.simulation.start is None:
        reasons |= {"training.window": start, "training.truths": start}
    for key, reason in reasons.items():
        section, _, name = key.partition(".")
        mine, whole = getattr(variant, section), getattr(scene, section)
        ours, theirs = getattr(mine, name, None), getattr(whole, name, None)
        if ours != theirs and (mine and whole or section == "training"):
            yield f"{place(name, section)} = {quoted(ours)} where the scene has {quoted(theirs)}: {reason}"


def _is_multiple(interval: float, unit: float) -> bool:
    ratio = interval / unit
    return round(ratio) >= 1 and abs(ratio - round(ratio)) < 1e-9 * ratio
