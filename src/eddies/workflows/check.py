"""`eddies check`: estimates and problems of a scene before a run. The command writes no file."""

import json
import logging
from collections.abc import Iterator, Mapping
from typing import Any

from eddies.parallel.communicator import Comm
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.estimates import estimate, in_units, measure, most_disk, most_ranks, storage
from eddies.workflows.problems import directory_problems, free_disk_at, memory_of_node, problems
from eddies.workflows.variants import steps

log = logging.getLogger("eddies")

SCALES = ("velocity_rms", "dissipation_rate", "integral_scale", "eddy_turnover_time", "reynolds_lambda",
          "kolmogorov_length", "kolmogorov_time", "kmax_eta")


def run(scene: Scene, comm: Comm, as_json: bool = False) -> None:
    """Log the estimates of a scene and its variants for `comm.size` ranks, or print them as JSON; all ranks call it.

    Raises SceneError at the end if a run would be refused.
    """
    if scene.of_tracks:
        from eddies.workflows.tracks import with_tracks  # imports torch
        scene = with_tracks(scene, comm)
    found, subject = numbers(scene, comm), ""
    if comm.rank == 0 and as_json:
        print(json.dumps(found, indent=2, allow_nan=False))
    elif comm.rank == 0:
        log.info("%s: %s", scene.name, scene.title)
        for title, line in lines(found):
            log.info("%-20s%s", "" if title == subject else title, line)
            subject = title
        for problem in found["warnings"]:
            log.warning(problem)
    for problem in found["refusals"]:
        raise SceneError(problem)


def numbers(scene: Scene, comm: Comm) -> dict[str, Any]:
    """Return all estimates, with the keys of docs/check-keys.csv. An unknown value is None. All ranks call it."""
    planned = steps(scene, scene.stages_of_all, scene.directory)
    measured, unfit = measure([scene, *(step.scene for step in planned)], comm)
    refusals, warnings = problems(scene, planned, comm, memory_of_node(comm), free_disk_at(scene.directory, comm),
                                  measured)
    refusals += [*unfit, *directory_problems(("report",), comm, scene.directory)]
    expected, limits, tracers = estimate(scene, measured), most_ranks(scene, measured), scene.tracers
    # Scenes by variant (None: shared by all variants) and stage. With realisations a stage has several scenes.
    work: dict[tuple[str | None, str], list[Scene]] = {}
    for step in sorted(planned, key=lambda step: [None, *scene.variant].index(step.variant)):
        for stage in step.stages:
            work.setdefault((step.variant, stage), []).append(step.scene)
    costs, needs = [], []
    for (variant, stage), scenes in work.items():
        needed = [storage(each, stage, comm.size, measured) for each in scenes]
        kept = [each.kept for each in needed]
        ranks = min(min(most_ranks(each.ground_truth_alone if stage == "dns" else each, measured).values())
                    for each in scenes)
        costs.append({"stage": stage, "variant": variant, "runs": len(scenes),
                      "memory": max(each.memory for each in needed), "disk": None if None in kept else sum(kept),
                      "scratch": needed[0].scratch, "most_ranks": ranks,
                      "least_memory": max(storage(each, stage, ranks, measured).memory for each in scenes)})
        needs += needed
    particles = tracers and (round(expected.tracks.mean_count) if expected.tracks else tracers.particles)
    return {
        "scene": scene.name, "stages": list(scene.stages_of_all), "cells": scene.flow.cells,
        "largest_wavenumber": scene.flow.largest_wavenumber,
        "turbulence": expected.scales and {name: expected.scales[name] for name in SCALES},
        "mach_turbulent": expected.mach, "particles": particles, "spacing": tracers and tracers.spacing,
        "filter_width": tracers and tracers.filter_width,
        "kernel_support": scene.kernel and tracers and tracers.radius_of(scene.kernel.neighbors),
        "time_step": expected.step, "limited_by": expected.step and f"[time] {expected.limited_by}",
        "steps": expected.steps, "frames": expected.frames,
        "ranks": comm.size, "most_ranks": min(limits.values()), "limits": limits, "stage_costs": costs,
        "totals": {"memory": max(row["memory"] for row in costs), "disk": sum(row["disk"] or 0.0 for row in costs),
                   "most_disk": most_disk(needs)},
        "warnings": warnings, "refusals": [*dict.fromkeys(refusals)],
    }


def lines(found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the estimates as text. Each item is a pair of a subject and a line."""
    for key, value in found.items():
        if key == "limits":
            yield from ((key, f"{ranks}: {reason}") for reason, ranks in value.items())
        elif key not in ("scene", "stage_costs", "totals", "warnings", "refusals"):
            yield key, as_text(value)
    rows = {name_of(row): row for row in found["stage_costs"]} | {"total": found["totals"]}
    width = max(map(len, rows))
    yield "costs", f"{'stage':{width}}  memory a rank       disk  most ranks"
    for name, row in rows.items():
        line = f"{name:{width}}  {in_units(row['memory']):>13}  "
        line += f"{'not known' if row['disk'] is None else in_units(row['disk']):>9}"
        if "most_ranks" in row:
            line += f"  {row['most_ranks']:>4}: {in_units(row['least_memory'])} a rank"
        yield "costs", line
    yield "costs", f"at most {in_units(found['totals']['most_disk'])} of disk at any moment"
    for problem in found["refusals"]:
        yield "fails here", problem


def as_text(value: Any) -> str:
    """Return an estimate as text."""
    if isinstance(value, dict):
        return ", ".join(f"{name} {as_text(part)}" for name, part in value.items())
    if isinstance(value, list):
        return ", ".join(value)
    return "not known" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)


def name_of(row: Mapping[str, Any]) -> str:
    """Return the name of a row of the table of stages."""
    name = f"{row['variant']}: {row['stage']}" if row["variant"] else row["stage"]
    return f"{name} ({row['runs']} times)" if row["runs"] > 1 else name
