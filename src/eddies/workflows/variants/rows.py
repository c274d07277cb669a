"""The numbers of a comparison: a row for every variant, and the machine that they were measured on."""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.analysis.accuracy import StoredRollout, accuracy
from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.io.provenance import environment
from eddies.io.trajectories import Trajectory
from eddies.kernels.library import threads
from eddies.measures import MEASURES
from eddies.parallel.communicator import Comm
from eddies.scene.comparison import Comparison
from eddies.scene.scene import Eulerian
from eddies.workflows.rollout.stored_spectra import read_spectra
from eddies.workflows.variants.run import StepSeconds, VariantRun

COST = ("seconds_per_step", "time_step", "wall_seconds", "wall_seconds_low", "wall_seconds_high", "core_seconds")
# Measured on gradients that the kernel makes of the particles, of the model and of the truth.
THROUGH_KERNEL = ("qr_kl", "qr_kl_floor")
COLUMNS = ("name", "group", "method", "status", "stopped_at", "realisations", *MEASURES, "end", *COST,
           "training_seconds", *(f"{measure}_spread" for measure in MEASURES), "settings")


def rows(comparison: Comparison, runs_of: Mapping[str, Sequence[VariantRun]], alone: Comm,
         ranks: int) -> list[dict[str, Any]]:
    """The row of every variant, by COLUMNS; None where there is no number. `runs_of` has the runs of each by name,
    `alone` is a communicator of one rank.

    Times are in turnovers T of the flow, `wall_seconds` and `core_seconds` for one of them.
    """
    found = []
    for variant in comparison.variant:
        runs = runs_of[variant.name]
        row: dict[str, Any] = dict.fromkeys(COLUMNS)
        row |= {"name": variant.name, "group": variant.group, "settings": " ".join(variant.set),
                "method": comparison.scenes[variant.name].simulation.method}
        failures = [run.failure for run in runs if run.failure is not None]
        if failures:
            row |= {"status": f"failed: {failures[0]}"}
        else:
            row |= together([measured(run, alone, ranks) for run in runs if "simulate" in run.stages])
            row |= {"training_seconds": training_seconds(runs, alone)}
            if has_own_kernel(comparison, variant.name):
                row |= dict.fromkeys(THROUGH_KERNEL)
        found.append({key: finite(value) for key, value in row.items()})
    return found


def together(realised: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """One row of those of several realisations: mean and, of several, standard deviation of the errors where all have
    one; the median of the times with the widest quartiles; the first that came to no end, if any."""
    row: dict[str, Any] = {"realisations": len(realised), "status": "complete"}
    row |= next(({key: one[key] for key in ("status", "stopped_at")} for one in realised
                 if one["status"] != "complete"), {})
    for key in (*MEASURES, "end"):
        values = [one[key] for one in realised]
        row[key] = None if None in values else float(np.mean(values))
        if key in MEASURES and finite(row[key]) is not None and len(values) > 1:
            row[f"{key}_spread"] = float(np.std(values, ddof=1))
    for key in COST:
        values = [one[key] for one in realised if one.get(key) is not None]
        choose = {"wall_seconds_low": min, "wall_seconds_high": max}.get(key, np.median)
        row[key] = float(choose(values)) if values else None
    return row


def training_seconds(runs: Sequence[VariantRun], alone: Comm) -> float | None:
    """How long the training took, where there was one."""
    for run in runs:
        if "train" in run.stages:
            with open_product(alone, run.directory / "model.h5", "model") as file:
                if "history" in file:
                    return float(read_table(file, "history")["seconds"][-1])
    return None


def has_own_kernel(comparison: Comparison, name: str) -> bool:
    """Whether a variant smooths with another kernel than the base: what is measured through it does not compare."""
    kernels = (scene.fingerprint("train-kernel") for scene in (comparison.scenes[name], comparison.base_scene))
    return len(set(kernels)) > 1


def notes(comparison: Comparison) -> list[str]:
    """What a reader has to know of the numbers: of how many flows they are, and what is special of single variants."""
    seeds = comparison.realisations
    found = [f"Mean and standard deviation over {len(seeds)} realisations, seeds {', '.join(map(str, seeds))}, that no "
             "training has seen." if seeds and len(seeds) > 1 else
             "Of one realisation: what differs less than from one flow to another is no difference."]
    own = [name for name in comparison.scenes if has_own_kernel(comparison, name)]
    blank = " and ".join(MEASURES[measure] for measure in THROUGH_KERNEL)
    if own:
        found.append(f"{', '.join(own)}: no {blank}. These are measured on what the smoothing kernel makes of the "
                     "particles; one of other settings than the base's shows another part of the flow.")
    grids = {name: (scene.eulerian or Eulerian()).cells_for(scene.tracers.filter_width)
             for name, scene in comparison.scenes.items() if scene.simulation.method == "eulerian"}
    if grids:
        kept = ", ".join(f"{(cells - 1) // 3} in {name}" for name, cells in grids.items())
        found.append(f"Of a grid the 2/3 rule leaves the wavenumbers |k_i| < cells/3, at most: {kept}; k_d = "
                     f"{np.pi / comparison.base_scene.tracers.filter_width:.3g}.")
    return found


def measured(run: VariantRun, alone: Comm, ranks: int) -> dict[str, Any]:
    """What rollout.h5 shows, and how long its steps took."""
    with (open_product(alone, run.directory / "ground_truth.h5", "ground_truth") as truth_file,
          open_product(alone, run.directory / "rollout.h5", "rollout") as file):
        reference, rollout = read_attributes(truth_file, "reference"), read_attributes(file, "rollout")
        model, truth = (Trajectory(file, name) for name in ("model", "truth"))
        stored = StoredRollout(
            model, truth, read_spectra(file, read_table(truth_file, "spectra")), model.length,
            turnover=rollout["eddy_turnover_time"], kolmogorov_time=reference["kolmogorov_time"],
            filter_wavenumber=np.pi / reference["filter_width"])
        complete = rollout["status"] == "complete"
        row = {"status": rollout["status"], "stopped_at": None if complete else rollout["turnovers"],
               **accuracy(stored, complete)}
    row["time_step"] = rollout.get("time_step")  # missing where the first step went wrong
    if samples := [*StepSeconds.of_rollout(rollout), *run.blocks]:
        row |= step_costs(samples, rollout["time_step"], stored.turnover, ranks)
    return row


def step_costs(samples: list[StepSeconds], step: float, turnover: float, ranks: int) -> dict[str, float]:
    """Seconds a step, the median over all samples, and wall and core seconds a turnover with the widest quartiles."""
    seconds = float(np.median([sample.median for sample in samples]))
    steps = turnover / step
    return {"seconds_per_step": seconds, "wall_seconds": seconds * steps,
            "wall_seconds_low": min(sample.low for sample in samples) * steps,
            "wall_seconds_high": max(sample.high for sample in samples) * steps,
            "core_seconds": seconds * steps * ranks * threads()}


def finite(value: Any) -> Any:
    """The value, or None for a number that is none."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def machine(device: str, ranks: int) -> dict[str, Any]:
    """What the times depend on: processor, cores, ranks, threads, device, and the versions of all libraries."""
    name = torch.cuda.get_device_name() if device == "cuda" else device
    return {"processor": processor(), "cores": os.cpu_count(), "threads_per_rank": threads(), "device": name,
            **environment(ranks)}


def processor() -> str:
    """Name of the processor as Linux gives it, or else its architecture."""
    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
