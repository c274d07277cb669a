"""Estimates of a scene before a run: resolution, steps, ranks, memory, disk, time, and problems. Writes nothing."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eddies.clock import duration
from eddies.parallel.communicator import Comm
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.workflows.foreseen.numbers import (expected_step, expected_turbulence, flow_steps, largest_wavenumber, mach,
                                               rollout_of)
from eddies.workflows.foreseen.ranks import ground_truth_alone, most_ranks
from eddies.workflows.foreseen.seconds import seconds
from eddies.workflows.foreseen.storage import disk, in_units, memory, most_disk, scratch
from eddies.workflows.problems import here, problems
from eddies.workflows.variants import rollouts, steps

log = logging.getLogger("eddies")

OF_TURBULENCE = ("velocity_rms", "dissipation_rate", "reynolds_lambda", "turnover_time", "kolmogorov_length",
                 "kolmogorov_time")


def run(scene: Scene, comm: Comm, as_json: bool = False) -> None:
    """Log estimates of a scene with its variants and their stages on these ranks, or print them as JSON; all ranks call
    it. Raises SceneError, after all is shown, where a run would be refused."""
    found, subject = numbers(scene, comm), ""
    if comm.rank == 0 and as_json:
        print(json.dumps(found, indent=2, allow_nan=False))
    elif comm.rank == 0:
        log.info("%s: %s", scene.name, scene.title)
        for title, line in lines(scene, found):
            log.info("%-12s%s", "" if title == subject else title, line)
            subject = title
        for problem in found["warnings"]:
            log.warning(problem)
    for problem in found["refusals"]:
        raise SceneError(problem)


def numbers(scene: Scene, comm: Comm) -> dict[str, Any]:
    """All estimates by the keys that docs/check.md describes; None where a number is unknown before a run. All ranks
    call it."""
    step, turbulence, limits = expected_step(scene), expected_turbulence(scene), most_ranks(scene)
    courses = {name: rollout_of(variant) for name, variant in (scene.variant or {scene.name: scene}).items()}
    k_max, work, context = largest_wavenumber(scene), work_of(scene), here(scene, comm)
    found = problems(scene, context)
    costs = [cost(variant, stage, scenes, comm.size) for (variant, stage), scenes in work.items()]
    return {
        "scene": scene.name, "stages": list(scene.stages_of_all), "cells": scene.flow.cells,
        "largest_wavenumber": k_max,
        "turbulence": turbulence and {**{name: getattr(turbulence, name) for name in OF_TURBULENCE},
                                      "kmax_eta": k_max * turbulence.kolmogorov_length},
        "mach_turbulent": mach(scene),
        "particles": scene.tracers and scene.tracers.particles,
        "filter_width": scene.tracers and scene.tracers.filter_width,
        "kernel_support": scene.kernel_support,
        "time_step": step and step[0], "steps": flow_steps(scene),
        "rollouts": {name: course and vars(course) for name, course in courses.items()},
        "ranks": comm.size, "most_ranks": min(limits.values()), "limits": limits,
        "most_ranks_dns": min(most_ranks(ground_truth_alone(scene)).values()),
        "stage_costs": costs,
        "totals": {"seconds": sum(row["seconds"] or 0.0 for row in costs),
                   "memory": max(row["memory"] for row in costs), "disk": sum(row["disk"] or 0.0 for row in costs),
                   "most_disk": most_disk((each, stage) for (_, stage), scenes in work.items() for each in scenes)},
        "warnings": [problem.text for problem in found if not problem.fatal],
        "refusals": [problem.text for problem in found if problem.fatal],
    }


def work_of(scene: Scene) -> dict[tuple[str | None, str], list[Scene]]:
    """The scenes for which each stage runs, by variant (None: shared by all) and stage; several with realisations."""
    work: dict[tuple[str | None, str], list[Scene]] = {}
    planned = steps(scene, scene.stages_of_all, scene.directory)
    for step in sorted(planned, key=lambda step: [None, *scene.variant].index(step.variant)):
        for stage in step.stages:
            work.setdefault((step.variant, stage), []).append(step.scene)
    work[None, "report"] = [place.scene for places in rollouts(scene, scene.directory).values() for place in places]
    return work


def cost(variant: str | None, stage: str, scenes: Sequence[Scene], ranks: int) -> dict[str, Any]:
    """Time, memory and disk of a stage of some scenes, on the given ranks and on the most that it can use."""
    most = min(min(most_ranks(ground_truth_alone(each) if stage == "dns" else each).values()) for each in scenes)

    def total(values: Sequence[float | None]) -> float | None:
        return None if None in values else sum(values)

    return {"stage": stage, "variant": variant, "runs": 1 if stage == "report" else len(scenes),
            "seconds": total([seconds(each, stage, ranks) for each in scenes]),
            "memory": max(memory(each, stage, ranks) for each in scenes),
            "disk": total([disk(each, stage) for each in scenes]),
            "scratch": scratch(scenes[0]) if stage == "dns" else 0.0, "most_ranks": most,
            "least_seconds": total([seconds(each, stage, most) for each in scenes]),
            "least_memory": max(memory(each, stage, most) for each in scenes)}


def lines(scene: Scene, found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """The same as text: subject and line."""
    cells, tracers, turbulence, step = scene.flow.cells, scene.tracers, found["turbulence"], expected_step(scene)
    yield "grid", f"{cells}^3 cells, spacing {BOX_LENGTH / cells:.4g}, k_max {largest_wavenumber(scene)} (2/3 rule)"
    if turbulence is None:
        yield "turbulence", "not known: no forcing, no random start, or no viscosity"
    else:
        yield "turbulence", ("expected u' {velocity_rms:.3g}, dissipation rate {dissipation_rate:.3g}, Re_lambda "
                             "{reynolds_lambda:.3g}, turnover time {turnover_time:.3g}".format(**turbulence))
        yield "turbulence", ("Kolmogorov length {kolmogorov_length:.3g}, time {kolmogorov_time:.3g}, k_max eta "
                             "{kmax_eta:.3g}".format(**turbulence))
    if found["mach_turbulent"] is not None:
        yield "turbulence", f"turbulent Mach number {found['mach_turbulent']:.3g}"
    if tracers:
        passed = gaussian_transfer((tracers.particles_per_side / 2) ** 2, tracers.filter_width)
        yield "particles", (f"{tracers.particles_per_side}^3 = {tracers.particles}, mean spacing {tracers.spacing:.4g} "
                            f"= {tracers.spacing * cells / BOX_LENGTH:.3g} cells")
        yield "particles", (f"filter width {tracers.filter_width:.4g}, passes {passed:.2g} of the amplitude at the "
                            f"Nyquist wavenumber {tracers.particles_per_side / 2:g} of the particles")
        yield "particles", (f"filtered fields on {tracers.cells}^3 points, every "
                            f"{tracers.field_every * tracers.frame_interval:.3g}")
    if scene.kernel:
        yield "particles", f"kernel support {scene.kernel_support:.4g}, {scene.kernel.neighbors:g} neighbours"
    if step is None:
        yield "steps", "not known: the speed of the initial flow is not known"
    else:
        count = f", about {found['steps']} in all" if found["steps"] else ""
        yield "steps", f"direct simulation {step[0]:.4g}, {step[1]}{count}"
    alike: dict[str, list[str]] = {}
    for name, rollout in found["rollouts"].items():
        if rollout:
            alike.setdefault("{time_step:.3g}, about {steps} for {intervals} intervals between frames, {evaluations} "
                             "evaluations of the particles' rates".format(**rollout), []).append(name)
    for text, names in alike.items():
        yield "steps", f"rollout of {', '.join(names)}: {text}"
    yield "ranks", f"at most {found['most_ranks']}; the direct simulation alone at most {found['most_ranks_dns']}"
    for reason, ranks in found["limits"].items():
        yield "ranks", f"    {ranks}: {reason}"
    ranks = "1 rank" if found["ranks"] == 1 else f"{found['ranks']} ranks"
    yield "stages", f"on {ranks}, wall time within a factor of three; and on the most ranks that can be used"
    rows = {name_of(row): row for row in found["stage_costs"]} | {"in all": found["totals"]}
    width = max(map(len, rows))
    yield "stages", f"{'stage':{width}}  {'wall time':>12}  memory a rank      disk"
    for name, row in rows.items():
        size = "not known" if row["disk"] is None else in_units(row["disk"])
        line = f"{name:{width}}  {wall_time(row['seconds']):>12}  {in_units(row['memory']):>13}  {size:>8}"
        if "most_ranks" in row:
            line += f"  {row['most_ranks']:>4}: {wall_time(row['least_seconds'])}"
            line += f", {in_units(row['least_memory'])} a rank"
        yield "stages", line
    yield "stages", f"at most {in_units(found['totals']['most_disk'])} of disk at any moment"
    for problem in found["refusals"]:
        yield "fails here", problem


def name_of(row: Mapping[str, Any]) -> str:
    """Name of a row of the stages."""
    name = f"{row['variant']}: {row['stage']}" if row["variant"] else row["stage"]
    return f"{name} ({row['runs']} times)" if row["runs"] > 1 else name


def wall_time(seconds: float | None) -> str:
    """Wall time as text."""
    return "not known" if seconds is None else duration(seconds)
