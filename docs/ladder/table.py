"""Writes the table of a run of the ladder, of its choices or its widths: each variant on the flows of the test.

    .venv/bin/python docs/ladder/table.py runs/ladder [--seconds]

Realisation 2 serves the choice, the others the test, whose mean and standard deviation stand in the table. With
`--seconds` the seconds of a turnover are measured, all rungs in turn on one core, else they are those of the last
measurement. Writes ../results/RUN.json, and for the ladder the figure ../paper/ladder.png: error at T over the cost of
a turnover.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

from eddies.report.figures import GUIDE, LOOKS, panels, plain_log_ticks, png, styled
from eddies.scene.scene import Scene, load_scene
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.measure import is_current, read
from eddies.workflows.rollout.method import TimeStep, make_method
from eddies.workflows.run_directory.work import read_found_step, step_path
from eddies.workflows.variants import rollouts

HERE = Path(__file__).parent
RESULTS, FIGURE = HERE.parent / "results", HERE.parent / "paper" / "ladder.png"
CHOICE = "realisation-2"
#: The rungs that the line of the figure connects, and those whose names stand beside their points.
LINE = "paper", "horizons-24", "local", "resolved"
NAMED = *LINE, "together", "to-resolved", "no-density"
FRAMES = 6  # of the timing
#: Measures by their names in the table of the page; the others are stored alone.
SHOWN = {"acceleration_error": "a priori", "velocity_error_half": "T/2", "velocity_error_end": "T",
         "plane_difference": "field at T", "energy_ratio": "energy", "spectrum_error": "spectrum",
         "count_variance": "counts"}
STORED = *SHOWN, "velocity_error_early"


def measures_of(directory: Path) -> dict[str, float | None]:
    """The measures of a rollout, and the time at which it broke off."""
    found, _ = read(directory, MPI.COMM_SELF)
    numbers = found["rollout"] | found["accuracy"]
    row = {name: numbers.get(name) for name in STORED}
    return row if numbers["stable"] else row | {"plane_difference": None, "broken": numbers["turnovers"]}


def step_of(directory: Path, scene: Scene) -> TimeStep:
    """The integrator and the step of a rollout, the converged ones or those of the scene."""
    path = step_path(scene.simulation, directory)
    if path is None:
        return TimeStep(scene.simulation.scheme.name, scene.simulation.longest_step)
    found, _ = read_found_step(path, MPI.COMM_SELF)
    return TimeStep(found["integrator"], found["size"])


@torch.no_grad()
def seconds_of(scene: Scene, directory: Path, step: TimeStep, truth: Path) -> float:
    """Seconds of a turnover on one core, from the steps of a few frames; NaN if the rollout breaks off."""
    with open_truth(MPI.COMM_SELF, truth) as opened:
        run, interval = make_method(scene, step, opened, 0, directory), scene.simulation.frame_interval
        began = start = math.nan
        for frame in range(1, FRAMES + 1):
            while run.time < frame * interval - 1e-9:
                if run.advance(frame * interval, 1) is not None:
                    return math.nan
            if frame == 1:  # the first steps are no measurement
                began, start = time.perf_counter(), run.time
        return (time.perf_counter() - began) / (run.time - start) * opened.reference["eddy_turnover_time"]


def cell(rows: list[dict], key: str) -> str:
    """Mean and standard deviation, or when the rollouts broke off."""
    broken = [row["broken"] for row in rows if "broken" in row]
    known = [row[key] for row in rows if row[key] is not None]
    if key == "velocity_error_end" and broken:
        return f"{len(broken)} of {len(rows)} break off, after {min(broken):.2g} T"
    if len(known) < len(rows):
        return ""
    return f"{np.mean(known):.3g}" + (f" ± {np.std(known, ddof=1):.1g}" if len(known) > 1 else "")


@styled
def figure(found: dict[str, dict]):
    """Velocity error at T over seconds a turnover: mean and standard deviation of the flows of the test."""
    drawn, axes = panels(1, 1, (7.0, 4.4))
    axis, points = axes[0, 0], {}
    for name, row in found.items():
        errors = [other["velocity_error_end"] for other in row["tests"]]
        if None not in errors and "seconds" in row:
            points[name] = row["seconds"], float(np.mean(errors)), float(np.std(errors, ddof=1))
    line = [name for name in LINE if name in points]
    axis.plot(*np.transpose([points[name][:2] for name in line]), color=GUIDE, linewidth=1, zorder=1)
    free = points.pop("no-force", None)
    if free is not None:
        axis.axhline(free[1], color=LOOKS["none"][0], linestyle="--", label="no force")
    for name, (cost, error, spread) in points.items():
        colour, marker = LOOKS.get(name, ("#444444" if name in NAMED else GUIDE, "o"))
        axis.errorbar(cost, error, spread, color=colour, marker=marker, markersize=6 if name in NAMED else 4,
                      linewidth=1, zorder=3 if name in NAMED else 2)
        if name in NAMED:
            axis.annotate(name, (cost, error), xytext=(6, 6), textcoords="offset points", fontsize=9)
    axis.errorbar([], [], [], color=GUIDE, marker="o", markersize=4, linestyle="none", label="other rungs (table)")
    costs = [cost for cost, *_ in points.values()]
    axis.set(xscale="log", xlim=(0.8 * min(costs), 1.7 * max(costs)), xlabel="seconds a turnover, one core",
             ylabel="velocity error at T", ylim=(0, None))
    plain_log_ticks(axis.xaxis)
    axis.legend(loc="lower left")
    return drawn


def main(run: Path, timed: bool) -> None:
    results = RESULTS / f"{run.name}.json"
    before = json.loads(results.read_text()) if results.exists() else {}
    scene, found = load_scene(run / "scene.toml"), {}
    for name, runs in rollouts(scene, run).items():
        paths, own = [*runs], scene.variant[name]
        if not all((path / "rollout.h5").exists() and is_current(path) for path in paths):
            print(f"{name}: left out, its rollouts or their measures are missing")
            continue
        step = step_of(run / name, own)
        row = {"step": step.size, "integrator": step.integrator}
        if (run / name / "model.h5").exists():
            row["training_seconds"] = json.loads((run / name / "stage_seconds.json").read_text()).get("train")
        if timed:
            row["seconds"] = seconds_of(runs[paths[1]], paths[1], step, paths[1] / "ground_truth.h5")
        elif "seconds" in before.get(name, {}):
            row["seconds"] = before[name]["seconds"]
        measures = {path.name: measures_of(path) for path in paths}
        row |= {"choice": measures.pop(CHOICE)} if CHOICE in measures else {}
        found[name] = row | {"tests": [*measures.values()]}
    results.write_text(json.dumps(found, indent=1) + "\n")
    if run.name == "ladder":
        FIGURE.write_bytes(png(figure(found)))
    print(f"| rung | seconds a turnover | training (s) | {' | '.join(SHOWN.values())} |")
    print("|---" * (3 + len(SHOWN)) + "|")
    for name, row in found.items():
        seconds = f"{row['seconds']:.2g}" if row.get("seconds", math.nan) > 0 else ""
        training = f"{float(format(row['training_seconds'], '.2g')):g}" if row.get("training_seconds") else ""
        cells = (cell(row["tests"], key) for key in SHOWN)
        print(f"| `{name}` | {seconds} | {training} | {' | '.join(cells)} |")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--seconds", action="store_true", help="measure the seconds of a turnover")
    given = parser.parse_args()
    main(given.run, given.seconds)
