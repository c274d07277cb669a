"""What a scene amounts to, told before a run: resolution, steps, ranks, memory, disk, time, and what may go wrong.
Writes nothing."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Mapping
from typing import Any

from eddies.clock import duration
from eddies.io.new_files import LARGEST_BYTES, has_single_writer
from eddies.parallel.communicator import Comm
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.workflows.foreseen.numbers import (expected_step, expected_turbulence, flow_steps, largest_wavenumber, mach,
                                               rollout_of)
from eddies.workflows.foreseen.problems import refusals, warnings
from eddies.workflows.foreseen.ranks import ground_truth_alone, most_ranks
from eddies.workflows.foreseen.seconds import seconds
from eddies.workflows.foreseen.storage import disk, in_units, memory, most_disk, scratch

log = logging.getLogger("eddies")

OF_TURBULENCE = ("velocity_rms", "dissipation_rate", "reynolds_lambda", "turnover_time", "kolmogorov_length",
                 "kolmogorov_time")


def run(scene: Scene, comm: Comm, as_json: bool = False) -> None:
    """Log what a scene amounts to and what its stages need on these ranks, with warnings; or print it as JSON. All
    ranks call it."""
    found, subject = numbers(scene, comm), ""
    if comm.rank == 0 and as_json:
        print(json.dumps(found, indent=2, allow_nan=False))
    elif comm.rank == 0:
        log.info("%s: %s", scene.name, scene.title)
        for title, line in lines(scene, found, has_single_writer(comm)):
            log.info("%-12s%s", "" if title == subject else title, line)
            subject = title
        for problem in found["warnings"]:
            log.warning(problem)


def numbers(scene: Scene, comm: Comm) -> dict[str, Any]:
    """All that is known of a scene; docs/check.md describes every key. None stands for what is not known before a
    run; all ranks call it."""
    step, turbulence, rollout = expected_step(scene), expected_turbulence(scene), rollout_of(scene)
    limits, alone = most_ranks(scene), most_ranks(ground_truth_alone(scene))
    stages = []
    for stage in scene.stages:
        most = min((alone if stage == "dns" else limits).values())
        stages.append({"stage": stage, "seconds": seconds(scene, stage, comm.size),
                       "memory": memory(scene, stage, comm.size), "disk": disk(scene, stage),
                       "scratch": scratch(scene) if stage == "dns" else 0.0, "most_ranks": most,
                       "least_seconds": seconds(scene, stage, most), "least_memory": memory(scene, stage, most)})
    return {
        "scene": scene.name, "stages": list(scene.stages), "cells": scene.flow.cells,
        "largest_wavenumber": largest_wavenumber(scene),
        "turbulence": turbulence and {**{name: getattr(turbulence, name) for name in OF_TURBULENCE},
                                      "kmax_eta": largest_wavenumber(scene) * turbulence.kolmogorov_length},
        "mach_turbulent": mach(scene),
        "particles": scene.tracers and scene.tracers.particles,
        "filter_width": scene.tracers and scene.tracers.filter_width,
        "kernel_support": scene.kernel_support,
        "time_step": step and step[0], "steps": flow_steps(scene), "rollout": rollout and vars(rollout),
        "ranks": comm.size, "most_ranks": min(limits.values()), "limits": limits,
        "most_ranks_dns": min(alone.values()),
        "stage_costs": stages,
        "totals": {"seconds": sum(stage["seconds"] or 0.0 for stage in stages),
                   "memory": max(stage["memory"] for stage in stages),
                   "disk": sum(stage["disk"] or 0.0 for stage in stages), "most_disk": most_disk(scene)},
        "warnings": list(warnings(scene, comm.size)), "refusals": refusals(scene, comm),
    }


def lines(scene: Scene, found: Mapping[str, Any], single_writer: bool) -> Iterator[tuple[str, str]]:
    """The same for people: subject and line."""
    cells, tracers, turbulence, step = scene.flow.cells, scene.tracers, found["turbulence"], expected_step(scene)
    if scene.variant:
        yield "variants", (f"{', '.join(scene.variant)}; these numbers are those of the scene, --variant NAME gives "
                           "others")
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
        end = tracers.particles_per_side / 2
        passed, at_end = (gaussian_transfer(k**2, tracers.filter_width) for k in (largest_wavenumber(scene), end))
        yield "particles", (f"{tracers.particles_per_side}^3 = {tracers.particles}, mean spacing {tracers.spacing:.4g} "
                            f"= {tracers.spacing * cells / BOX_LENGTH:.3g} cells")
        yield "particles", (f"filter width {tracers.filter_width:.4g}, passes {passed:.2g} of the amplitude at k_max "
                            f"and {at_end:.2g} at k = {end:g}, where the particles' resolution ends")
        yield "particles", (f"filtered fields on {tracers.cells}^3 points, every "
                            f"{tracers.field_every * tracers.frame_interval:.3g}")
    if scene.kernel:
        yield "particles", f"kernel support {scene.kernel_support:.4g}, {scene.kernel.neighbors:g} neighbours"
    if step is None:
        yield "steps", "not known: the speed of the initial flow is not known"
    else:
        count = f", about {found['steps']} in all" if found["steps"] else ""
        yield "steps", f"direct simulation {step[0]:.4g}, {step[1]}{count}"
    if found["rollout"]:
        yield "steps", ("rollout {time_step:.3g}, about {steps} for {intervals} intervals between frames, "
                        "{evaluations} evaluations of the particles' rates".format(**found["rollout"]))
    yield "ranks", f"at most {found['most_ranks']}; the direct simulation alone at most {found['most_ranks_dns']}"
    for reason, ranks in found["limits"].items():
        yield "ranks", f"    {ranks}: {reason}"
    if single_writer:
        yield "ranks", f"rank 0 writes for all, up to {in_units(LARGEST_BYTES)} a file: this h5py is built without MPI"
    ranks = "1 rank" if found["ranks"] == 1 else f"{found['ranks']} ranks"
    yield "stages", f"on {ranks}, wall time within a factor of three; and on the most ranks that can be used"
    yield "stages", "stage            wall time  memory a rank      disk"
    for row in [*found["stage_costs"], {"stage": "in all", **found["totals"]}]:
        size = "not known" if row["disk"] is None else in_units(row["disk"])
        line = f"{row['stage']:12}  {wall_time(row['seconds']):>12}  {in_units(row['memory']):>13}  {size:>8}"
        if "most_ranks" in row:
            least = wall_time(row["least_seconds"])
            line += f"  {row['most_ranks']:>4}: {least}, {in_units(row['least_memory'])} a rank"
        yield "stages", line
    yield "stages", f"at most {in_units(found['totals']['most_disk'])} of disk at any moment"
    for problem in found["refusals"]:
        yield "fails here", problem


def wall_time(seconds: float | None) -> str:
    """Wall time as text."""
    return "not known" if seconds is None else duration(seconds)
