"""The numbers of the table of variants: a row for each, and the machine that they were measured on."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.accuracy import accuracy
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import environment, read_json
from eddies.cores import threads
from eddies.measures import MEASURES
from eddies.parallel.communicator import Comm
from eddies.pipeline import STAGES
from eddies.scene.scene import Eulerian, Scene
from eddies.scene.sections import CONVERGED
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import FAILURE
from eddies.workflows.variants import Place

COST = ("seconds_per_step", "time_step", "wall_seconds", "wall_seconds_low", "wall_seconds_high", "core_seconds",
        "ranks")
# Of the search for the step: integrator and step ("etdrk4" and a Courant number on a grid), seconds of the search, and
# errors of the short rollouts with it, half and twice of it.
SEARCH = ("step_integrator", "step_size", "step_seconds", "step_error", "step_error_half", "step_error_twice")
# What comes before a rollout: learned numbers, their training, and the search for its step.
BEFORE = ("weights", "training_seconds", "training_steps", *SEARCH)
# Measured on gradients that the kernel makes of the particles, of the model and of the truth.
THROUGH_KERNEL = ("qr_kl", "qr_kl_floor")
COLUMNS = ("name", "label", "method", "kind", "on_grid", "status", "stopped_at", "realisations", *MEASURES, "end",
           *COST, *BEFORE, *(f"{measure}_spread" for measure in MEASURES), "settings")
MODEL, ROLLOUT = STAGES["train"].file, STAGES["simulate"].file


def row(scene: Scene, name: str, places: Sequence[Place], alone: Comm) -> dict[str, Any]:
    """The row of a variant, or of a scene without any under its own name, by COLUMNS; None where there is no number.

    Times are in turnovers T of the flow, `wall_seconds` and `core_seconds` for one of them. One rank reads: `alone`.
    """
    variant = scene.variant.get(name, scene)
    found: dict[str, Any] = dict.fromkeys(COLUMNS)
    found |= {"name": name, "label": variant.label or name, "method": variant.simulation.method,
              "kind": variant.simulation.title, "on_grid": variant.simulation.on_grid,
              "settings": "; ".join(scene.differences(variant)) if scene.variant else ""}
    missing = [place.directory for place in places if not (place.directory / ROLLOUT).exists()]
    if missing:
        found |= {"status": why_not(missing[0])}
    else:
        found |= together([measured(place.directory, alone) for place in places])
        found |= before(places[0], alone)
        if has_own_kernel(scene, variant):
            found |= dict.fromkeys(THROUGH_KERNEL)
    return {key: finite(value) for key, value in found.items()}


def why_not(directory: Path) -> str:
    """Why there is no rollout."""
    for path in (directory / FAILURE, directory.parent / FAILURE):
        if path.is_file():
            return f"failed: {path.read_text(encoding='utf-8').strip()}"
    return "not run"


def together(realised: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row of those of several realisations: mean and, of several, standard deviation of the errors where all have
    one; the median of the times with the widest quartiles; the first that came to no end, if any."""
    found: dict[str, Any] = {"realisations": len(realised), "status": "complete"}
    found |= next(({key: one[key] for key in ("status", "stopped_at")} for one in realised
                   if one["status"] != "complete"), {})
    for key in (*MEASURES, "end"):
        values = [one[key] for one in realised]
        found[key] = None if None in values else float(np.mean(values))
        if key in MEASURES and finite(found[key]) is not None and len(values) > 1:
            found[f"{key}_spread"] = float(np.std(values, ddof=1))
    for key in COST:
        values = [one[key] for one in realised if one.get(key) is not None]
        choose = {"wall_seconds_low": min, "wall_seconds_high": max}.get(key, np.median)
        found[key] = float(choose(values)) if values else None
    return found


def before(place: Place, alone: Comm) -> dict[str, Any]:
    """Of BEFORE what there is: of the model, where the rollout has one, the training as it is stored with its weights,
    whoever trained them; nothing of what is not stored."""
    found: dict[str, Any] = {}
    path = place.directory / MODEL
    if place.scene.needs_model and path.exists():
        with open_product(alone, path, "model") as file:
            phases = read_json(file, "description").get("training")
            found["weights"] = sum(dataset.size for dataset in file["weights"].values())
        if phases is not None:
            found["training_seconds"] = float(sum(phase["seconds"] for phase in phases))
            found["training_steps"] = sum(phase["steps"] for phase in phases)
    step = place.scene.step_file or place.directory / STAGES["find-step"].file
    if place.scene.simulation.step == CONVERGED and step.exists():
        found |= searched(step, alone)
    return found


def searched(path: Path, alone: Comm) -> dict[str, Any]:
    """SEARCH as the file of a step has it; no error of twice the step where that was not tried, or went wrong."""
    with open_product(alone, path, "step") as file:
        step = read_attributes(file, "found")
        tried = read_table(file, f"trials/{step['integrator']}")
    twice = tried["error"][np.isclose(tried["size"], 2 * step["size"])]
    return dict(zip(SEARCH, (step["integrator"], step["size"], step["seconds"], step["error"], step["error_with_half"],
                             float(twice[0]) if len(twice) else None)))


def has_own_kernel(scene: Scene, variant: Scene) -> bool:
    """Whether a variant smooths with another kernel than the scene: what is measured through it does not compare."""
    return len({stage_fingerprint(each, "train-kernel") for each in (scene.without_variants, variant)}) > 1


def notes(scene: Scene) -> list[str]:
    """What a reader has to know of the numbers: of how many flows they are, and what is special of single variants."""
    seeds, variants = scene.realisations, scene.variant or {scene.name: scene}
    found = [f"Mean and standard deviation over {len(seeds)} realisations, seeds {', '.join(map(str, seeds))}, that no "
             "training has seen." if seeds and len(seeds) > 1 else
             "Of one realisation: a difference that is smaller than that between two flows is no difference."]
    own = [name for name, variant in variants.items() if has_own_kernel(scene, variant)]
    blank = " and ".join(MEASURES[measure] for measure in THROUGH_KERNEL)
    if own:
        found.append(f"{', '.join(own)}: no {blank}. These are measured on what the smoothing kernel makes of the "
                     "particles; a kernel of other settings than the scene's shows another part of the flow.")
    grids = {name: (variant.eulerian or Eulerian()).cells_for(variant.tracers.filter_width)
             for name, variant in variants.items() if variant.simulation.on_grid}
    if grids:
        kept = ", ".join(f"{(cells - 1) // 3} in {name}" for name, cells in grids.items())
        found.append(f"Of a grid the 2/3 rule leaves the wavenumbers |k_i| < cells/3, at most: {kept}; k_d = "
                     f"{np.pi / scene.tracers.filter_width:.3g}.")
    return found


def measured(directory: Path, alone: Comm) -> dict[str, Any]:
    """What the rollout of a run directory shows, and how long its steps took."""
    from eddies.workflows.rollout.measured import open_rollout  # torch, which the report on other products does without
    with open_rollout(directory, alone) as stored:
        stored.measure(alone, whole=False)
        rollout = stored.rollout
        attributes, ranks = rollout.attributes, stored.provenance["ranks"]
        found = {"status": rollout.status, "ranks": ranks, **accuracy(rollout),
                 "stopped_at": None if rollout.status == "complete" else attributes["turnovers"]}
    found["time_step"] = attributes.get("time_step")  # missing where the first step went wrong
    if "seconds_per_step" in attributes:
        found |= step_costs(attributes, rollout.turnover, ranks)
    return found


def step_costs(rollout: Mapping[str, Any], turnover: float, ranks: int) -> dict[str, float]:
    """Seconds a step, and wall and core seconds a turnover with quartiles, from what a rollout has timed."""
    seconds, low, high = (rollout[f"seconds_per_step{end}"] for end in ("", "_low", "_high"))
    steps = turnover / rollout["time_step"]
    return {"seconds_per_step": seconds, "wall_seconds": seconds * steps, "wall_seconds_low": low * steps,
            "wall_seconds_high": high * steps, "core_seconds": seconds * steps * ranks * threads()}


def finite(value: Any) -> Any:
    """The value, or None for a number that is none."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def machine(device: str, ranks: int) -> dict[str, Any]:
    """What the times depend on: processor, cores, ranks, threads, device, and the versions of all libraries."""
    if device == "cuda":
        import torch
        device = torch.cuda.get_device_name()
    return {"processor": processor(), "cores": os.cpu_count(), "threads_per_rank": threads(), "device": device,
            **environment(ranks)}


def processor() -> str:
    """Name of the processor as Linux gives it, or else its architecture."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
