"""`eddies check`: estimates and problems of a scene before a run. The command writes no file."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from eddies.clock import duration
from eddies.parallel.communicator import Comm
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.foreseen.numbers import estimate
from eddies.workflows.foreseen.ranks import most_ranks
from eddies.workflows.foreseen.seconds import seconds
from eddies.workflows.foreseen.storage import Storage, in_units, most_disk, storage
from eddies.workflows.problems import directory_problems, free_disk_at, memory_of_node, problems
from eddies.workflows.variants import rollouts, steps

log = logging.getLogger("eddies")

TURBULENCE_KEYS = ("velocity_rms", "dissipation_rate", "reynolds_lambda", "turnover_time", "kolmogorov_length",
                   "kolmogorov_time")
Foreseen = tuple[float | None, Storage]  # wall time of a stage, and its memory and disk space


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
    """Return all estimates, with the keys that docs/check.md describes. An unknown value is None. All ranks call it."""
    expected, tracers, k_max = estimate(scene), scene.tracers, scene.flow.largest_wavenumber
    rollout_of = {name: estimate(each).rollout for name, each in (scene.variant or {scene.name: scene}).items()}
    planned = steps(scene, scene.stages_of_all, scene.directory)
    refusals, warnings = problems(scene, planned, comm, memory_of_node(comm), free_disk_at(scene.directory, comm))
    of_report, limits = directory_problems(("report",), comm, scene.directory), most_ranks(scene)
    turbulence = expected.turbulence
    # Scenes by variant (None: shared by all variants) and stage. With realisations a stage has several scenes.
    work: dict[tuple[str | None, str], list[Scene]] = {}
    for step in sorted(planned, key=lambda step: [None, *scene.variant].index(step.variant)):
        for stage in step.stages:
            work.setdefault((step.variant, stage), []).append(step.scene)
    pages = [each for runs in rollouts(scene, scene.directory).values() for each in runs.values()]
    work[None, "report"] = pages or [scene]
    costs, needs = [], []
    for (variant, stage), scenes in work.items():
        most = min(min(most_ranks(each.ground_truth_alone if stage == "dns" else each).values()) for each in scenes)
        here, there = ([(seconds(each, stage, ranks), storage(each, stage, ranks)) for each in scenes]
                       for ranks in (comm.size, most))
        costs.append(row(stage, variant, here, most, there))
        needs += [needed for _, needed in here]
    return {
        "scene": scene.name, "stages": list(scene.stages_of_all), "cells": scene.flow.cells,
        "largest_wavenumber": k_max,
        "turbulence": turbulence and {**{name: getattr(turbulence, name) for name in TURBULENCE_KEYS},
                                      "kmax_eta": k_max * turbulence.kolmogorov_length},
        "mach_turbulent": expected.mach,
        "particles": tracers and tracers.particles, "spacing": tracers and tracers.spacing,
        "filter_width": tracers and tracers.filter_width, "kernel_support": scene.kernel_support,
        "time_step": expected.step, "limited_by": expected.step and f"[time] {expected.limited_by}",
        "steps": expected.steps,
        "rollouts": {name: rollout and vars(rollout) for name, rollout in rollout_of.items()},
        "ranks": comm.size, "most_ranks": min(limits.values()), "limits": limits,
        "most_ranks_dns": min(most_ranks(scene.ground_truth_alone).values()),
        "stage_costs": costs,
        "totals": {"seconds": sum(row["seconds"] or 0.0 for row in costs),
                   "memory": max(row["memory"] for row in costs), "disk": sum(row["disk"] or 0.0 for row in costs),
                   "most_disk": most_disk(needs)},
        "warnings": warnings, "refusals": [*dict.fromkeys([*refusals, *of_report])],
    }


def row(stage: str, variant: str | None, here: Sequence[Foreseen], most_ranks: int,
        there: Sequence[Foreseen]) -> dict[str, Any]:
    """Return a row of `stage_costs`: the cost of a stage for several scenes.

    `here` is the cost for each scene on the ranks of this job. `there` is the cost on `most_ranks`, the largest number
    of ranks that the stage can use; it gives `least_seconds` and `least_memory`. Wall times and `disk` are sums over
    the scenes; `memory`, in bytes per rank, is the largest value. The stage leaves `disk` bytes, and removes `scratch`
    bytes at its end.
    """
    def total(values: Sequence[float | None]) -> float | None:
        return None if None in values else sum(values)

    return {"stage": stage, "variant": variant, "runs": 1 if stage == "report" else len(here),
            "seconds": total([each for each, _ in here]), "memory": max(needed.memory for _, needed in here),
            "disk": total([needed.kept for _, needed in here]), "scratch": here[0][1].scratch, "most_ranks": most_ranks,
            "least_seconds": total([each for each, _ in there]),
            "least_memory": max(needed.memory for _, needed in there)}


def lines(found: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the estimates as text. Each item is a pair of a subject and a line."""
    for key, value in found.items():
        if key == "limits":
            yield from ((key, f"{ranks}: {reason}") for reason, ranks in value.items())
        elif key == "rollouts":
            yield from ((key, f"{name}: {as_text(rollout)}") for name, rollout in value.items())
        elif key not in ("scene", "stage_costs", "totals", "warnings", "refusals"):
            yield key, as_text(value)
    rows = {name_of(row): row for row in found["stage_costs"]} | {"total": found["totals"]}
    width = max(map(len, rows))
    yield "costs", ("on these ranks, then on the most ranks that a stage can use; wall times are right within a factor "
                    "of three")
    yield "costs", f"{'stage':{width}}  {'wall time':>12}  memory a rank      disk"
    for name, row in rows.items():
        line = f"{name:{width}}  {wall_time(row['seconds']):>12}  {in_units(row['memory']):>13}  "
        line += f"{'not known' if row['disk'] is None else in_units(row['disk']):>8}"
        if "most_ranks" in row:
            line += f"  {row['most_ranks']:>4}: {wall_time(row['least_seconds'])}"
            line += f", {in_units(row['least_memory'])} a rank"
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


def wall_time(seconds: float | None) -> str:
    """Return a wall time as text."""
    return "not known" if seconds is None else duration(seconds)
