"""The rows of the table of variants, and a description of the machine on which the times were measured."""

import os
import platform
from collections.abc import Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from eddies.cores import threads
from eddies.io.hdf5 import open_product
from eddies.io.provenance import environment, read_json
from eddies.measures import MEASURES, finite
from eddies.parallel.communicator import Comm
from eddies.parallel.step_times import was_busy
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import FAILURE, of_other_settings, read_found_step, step_path

COST = ("seconds_per_step", "time_step", "wall_seconds", "wall_seconds_low", "wall_seconds_high", "core_seconds",
        "surplus_load",
        "switches_per_step", "ranks")
# The search for the step: integrator and step ("etdrk4" and a Courant number on a grid), wall seconds of the search,
# and the errors of short rollouts with this step, with half of it and with twice this step.
SEARCH = ("step_integrator", "step_size", "step_seconds", "step_error", "step_error_half", "step_error_twice")
BEFORE = ("weights", "training_seconds", "training_steps", *SEARCH)  # cost before the rollout
THROUGH_KERNEL = ("qr_kl", "qr_kl_floor")  # measured on gradients that the smoothing kernel reconstructs
COLUMNS = ("name", "label", "method", "kind", "on_grid", "status", "stopped_at", "realisations", *MEASURES, "end",
           *COST, "busy", *BEFORE, *(f"{measure}_spread" for measure in MEASURES), "settings")
MODEL, ROLLOUT = STAGES["train"].file, STAGES["simulate"].file


def rows_of(scene: Scene, runs: Mapping[str, Sequence[Path]], measured: Mapping[str, Sequence[Mapping[str, Any]]],
            alone: Comm, old: Mapping[Path, Sequence[str]] = MappingProxyType({}),
            ) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the rows of the table, and the names of variants with another kernel.

    There is a row for each variant, or one row for a scene without variants. A row has the keys COLUMNS; a missing
    number is None. The kernel of a variant is compared with that of the scene or, if the scene has sets of tracers,
    with that of the first variant. If it differs, the numbers THROUGH_KERNEL cannot be compared with those of other
    variants, and are left out.

    runs: directories of each variant's rollouts. measured: `numbers` of all rollouts of each variant, without variants
    for which a rollout is missing. old: the products that were made with other settings, by path, with the settings
    that differ. A variant with such a rollout has no numbers, because it cannot be compared with the others. Times are
    in turnovers T; `wall_seconds` and `core_seconds` are per turnover.
    """
    kernel_of = partial(stage_fingerprint, stage="train-kernel")
    kernels = {name: kernel_of(variant) for name, variant in scene.variant.items()}
    common = next(iter(kernels.values())) if scene.sets else kernel_of(scene.without_variants)
    different = [name for name, kernel in kernels.items() if kernel != common]
    rows = []
    for name, directories in runs.items():
        variant, first = scene.variant.get(name, scene), directories[0]
        simulation = variant.simulation
        found: dict[str, Any] = dict.fromkeys(COLUMNS)
        found |= {"name": name, "label": variant.label or name, "method": simulation.method,
                  "kind": simulation.form.title, "on_grid": simulation.form.on_grid,
                  "settings": "; ".join(scene.differences(name)) if scene.variant else ""}
        other = next((each for each in directories if old.get(each / ROLLOUT)), None)
        if name in measured and other is None:
            step = step_path(simulation, first.parent if scene.realisations else first)
            found |= combined(measured[name])
            found |= before(first / MODEL if variant.needs_model else None, step, alone)
        else:
            lacking = other or next(each for each in directories if not (each / ROLLOUT).exists())
            found["status"] = missing_reason(lacking, old.get(lacking / ROLLOUT, ()))
        if name in different:
            found |= dict.fromkeys(THROUGH_KERNEL)
        rows.append({key: finite(value) for key, value in found.items()})
    return rows, different


def missing_reason(directory: Path, changes: Sequence[str] = ()) -> str:
    """Return why the run directory of a variant has no rollout to compare. `changes` are the settings in which its
    rollout differs from the scene."""
    for path in (directory / FAILURE, directory.parent / FAILURE):
        if path.is_file():
            return f"failed: {path.read_text(encoding='utf-8').strip()}"
    return f"left out, because its rollout was made with {of_other_settings(changes)}" if changes else "not run"


def combined(realised: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Combine the numbers of several realisations.

    Each measure becomes a mean and a standard deviation, if all realisations have it. Each time becomes a median. Of
    the lower quartiles the lowest is kept, and of the upper quartiles the highest. The status comes from the first
    realisation that did not reach its end, if there is one. The machine was busy if it was in one realisation.
    """
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
    found["busy"] = any(one.get("busy") for one in realised)
    return found


def simulation_seconds(rows: Sequence[Mapping[str, Any]], repeating: Collection[str],
                       of_truth: float | None) -> float | None:
    """Return the wall seconds per turnover of the direct simulation.

    `repeating` are the names of variants on the grid of the direct simulation, which are timed like the other variants.
    The result is the time of the fastest of them. If there is none, the result is `of_truth`, the time of the ground
    truth.
    """
    repeated = [row["wall_seconds"] for row in rows if row["wall_seconds"] is not None and row["name"] in repeating]
    return min(repeated, default=of_truth)


def before(model: Path | None, step: Path | None, alone: Comm) -> dict[str, Any]:
    """Return the numbers of BEFORE that are stored in the files of the model and of the step."""
    found: dict[str, Any] = {}
    if model is not None and model.exists():
        with open_product(alone, model, "model") as file:
            phases = read_json(file, "description").get("training")
            found["weights"] = sum(dataset.size for dataset in file["weights"].values())
        if phases is not None:
            found["training_seconds"] = float(sum(phase["seconds"] for phase in phases))
            found["training_steps"] = sum(phase["steps"] for phase in phases)
    if step is not None and step.exists():
        chosen, tried = read_found_step(step, alone)
        twice = tried["error"][np.isclose(tried["size"], 2 * chosen["size"], atol=0)]
        found |= zip(SEARCH, (chosen["integrator"], chosen["size"], chosen["seconds"], chosen["error"],
                              chosen["error_with_half"], float(twice[0]) if len(twice) else None))
    return found


def notes(seeds: Sequence[int], without_kernel: Sequence[str], variants: Mapping[str, Scene]) -> list[str]:
    """Return the sentences that a reader needs to interpret the numbers.

    seeds: seeds of the realisations. without_kernel: names of the variants without the numbers THROUGH_KERNEL.
    """
    found = [f"Mean and standard deviation over {len(seeds)} realisations, seeds {', '.join(map(str, seeds))}, that no "
             "training has seen." if len(seeds) > 1 else
             "All numbers are from one realisation, so small differences may be due to chance."]
    if without_kernel:
        blank = " and ".join(MEASURES[measure] for measure in THROUGH_KERNEL)
        found.append(f"{', '.join(without_kernel)}: no {blank}, because these numbers need the smoothing kernel, and "
                     "its settings differ there.")
    grids = {name: each.coarse_cells for name, each in variants.items() if each.coarse_cells}
    if grids:
        kept = ", ".join(f"{(count - 1) // 3} in {name}" for name, count in grids.items())
        widths = {variants[name].tracers.filter_width for name in grids}
        found.append(f"Largest wavenumber |k_i| that a grid keeps by the 2/3 rule: {kept}; the filter wavenumber "
                     f"k_d = pi/d is "
                     f"{', '.join(f'{np.pi / width:.3g}' for width in sorted(widths, reverse=True))}.")
    if len({(each.tracers.particles, each.tracers.filter_width) for each in variants.values()}) > 1:
        found.append("Variants have different particles or filters. Compare only those with the same ones.")
    return found


def numbers(measured: Mapping[str, Any]) -> dict[str, Any]:
    """Return status, accuracy and cost of a rollout from the numbers of its measures.

    Costs are the seconds per step, and per turnover the wall seconds (with quartiles) and the core seconds. `busy`
    tells whether the machine was busy while they were measured.
    """
    rollout, ranks = measured["attributes"], measured["ranks"]
    found = {"status": rollout["status"], "ranks": ranks, **measured["accuracy"],
             "stopped_at": None if rollout["status"] == "complete" else rollout["turnovers"],
             "time_step": rollout.get("time_step")}  # missing if the first step failed
    if "seconds_per_step" in rollout:
        steps = rollout["eddy_turnover_time"] / rollout["time_step"]
        seconds, low, high = (rollout[f"seconds_per_step{end}"] for end in ("", "_low", "_high"))
        found |= {"seconds_per_step": seconds, "wall_seconds": seconds * steps, "wall_seconds_low": low * steps,
                  "wall_seconds_high": high * steps, "core_seconds": seconds * steps * ranks * threads(),
                  "surplus_load": rollout.get("surplus_load"), "switches_per_step": rollout.get("switches_per_step"),
                  "busy": was_busy(rollout)}
    return found


def machine(device: str, ranks: int) -> dict[str, Any]:
    """Return what the times depend on: processor, cores, ranks, threads, device, versions of libraries."""
    if device == "cuda":
        import torch
        if torch.cuda.is_available():  # the report may be made on another machine
            device = torch.cuda.get_device_name()
    return {"processor": processor(), "cores": os.cpu_count(), "threads_per_rank": threads(), "device": device,
            **environment(ranks)}


def processor() -> str:
    """Return the name of the processor as Linux gives it, or else its architecture."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
