"""Writes the results of a run of the ladder, of its choices or of other filters: each variant on the flows of the test.

    .venv/bin/python docs/ladder/table.py runs/ladder [--seconds]

Realisation 2 of the ladder serves the choice, all others the test, whose mean and standard deviation stand in the
tables of the page (`docs/tables.py`). With `--seconds` the seconds of a turnover are measured, all rungs in turn on one
core, else they are those of the last measurement. Writes ../results/RUN.json, where variants without rollouts keep
their rows, and for the ladder the figure ../paper/ladder.png: error at T over the cost of a turnover.
"""

import argparse
import json
import math
import time
from pathlib import Path

import numpy as np
import torch
from mpi4py import MPI

from eddies.io.hdf5 import open_product
from eddies.report.figures import GUIDE, LOOKS, OUTLINED, panels, plain_log_ticks, png, styled
from eddies.scene.scene import Scene, load_scene
from eddies.scene.sections import Horizons
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
NAMED = *LINE, "local-pairs", "together", "to-resolved", "no-density"
BELOW = "local-pairs", "to-resolved"  # of these the names stand below
FRAMES = 6  # of the timing
STORED = ("acceleration_error", "velocity_error_early", "velocity_error_half", "velocity_error_end", "plane_difference",
          "energy_ratio", "spectrum_error", "count_variance")


def rounded(value: float | None) -> float | None:
    """The digits that are stored."""
    return None if value is None else float(f"{value:.5g}")


def measures_of(directory: Path) -> dict[str, float | None]:
    """The measures of a rollout, and the time at which it broke off."""
    found, _ = read(directory, MPI.COMM_SELF)
    numbers = found["rollout"] | found["accuracy"]
    row = {name: rounded(numbers.get(name)) for name in STORED}
    return row if numbers["stable"] else row | {"plane_difference": None, "broken": rounded(numbers["turnovers"])}


def horizon_errors(model: Path, horizons: Horizons) -> dict[str, float]:
    """The validation error at the longest horizon before the training through rollouts, as "0", and after each number
    of frames."""
    with open_product(MPI.COMM_SELF, model, "model") as file:
        phase, after, before = (file[f"history/{name}"][:] for name in ("phase", "validation_error", "start_error"))
    first = int(phase[-1]) - len(horizons.frames) + 1
    kept = [np.nanmin([before[phase == first + number][0], *after[phase == first + number]])
            for number in range(len(horizons.frames))]
    return {str(frames): rounded(error)
            for frames, error in zip((0, *horizons.frames), (before[phase == first][0], *kept))}


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


def combined(rows: list[dict]) -> dict[str, float | str | None]:
    """Means and standard deviations over flows; a word on rollouts that broke off."""
    broken = [row["broken"] for row in rows if "broken" in row]
    found: dict[str, float | str | None] = {}
    for key in STORED:
        values = [row[key] for row in rows]
        if None in values:
            found[key] = None
        else:
            found |= {key: rounded(np.mean(values)), f"{key}_spread": rounded(np.std(values, ddof=1))}
    if broken:
        found["velocity_error_end"] = f"{len(broken)} of {len(rows)} break off, after {min(broken):.2g} T"
    return found


@styled
def figure(rows: list[dict]):
    """Velocity error at T over seconds a turnover: mean and standard deviation of the flows of the test."""
    drawn, axes = panels(1, 1, (7.0, 4.4))
    axis, points = axes[0, 0], {}
    for row in rows:
        if "velocity_error_end_spread" in row and "wall_seconds" in row:
            points[row["name"]] = row["wall_seconds"], row["velocity_error_end"], row["velocity_error_end_spread"]
    line = [name for name in LINE if name in points]
    axis.plot(*np.transpose([points[name][:2] for name in line]), color=GUIDE, linewidth=1, zorder=1)
    free = points.pop("no-force", None)
    if free is not None:
        axis.axhline(free[1], color=LOOKS["none"][0], linestyle="--", label="no force")
    for name, (cost, error, spread) in points.items():
        preset = name.replace("-pairs", " + pairs")
        colour, marker = LOOKS.get(preset, ("#444444" if name in NAMED else GUIDE, "o"))
        axis.errorbar(cost, error, spread, color=colour, marker=marker, markersize=6 if name in NAMED else 4,
                      linewidth=1, zorder=3 if name in NAMED else 2)
        if name in NAMED:
            place = {"xytext": (0, -22), "ha": "center"} if name in BELOW else {"xytext": (6, 6)}
            axis.annotate(name, (cost, error), **place, textcoords="offset points", fontsize=9, path_effects=OUTLINED,
                          zorder=1.5)
    axis.errorbar([], [], [], color=GUIDE, marker="o", markersize=4, linestyle="none", label="other rungs (table)")
    costs = [cost for cost, *_ in points.values()]
    axis.set(xscale="log", xlim=(0.8 * min(costs), 1.7 * max(costs)), xlabel="seconds a turnover, one core",
             ylabel="velocity error at T", ylim=(0, None))
    plain_log_ticks(axis.xaxis)
    axis.legend(loc="lower left")
    return drawn


def main(run: Path, timed: bool) -> None:
    results = RESULTS / f"{run.name}.json"
    before = {row["name"]: row for row in json.loads(results.read_text())["rows"]} if results.exists() else {}
    scene, rows = load_scene(run / "scene.toml"), []
    for name, runs in rollouts(scene, run).items():
        paths, own = [*runs], scene.variant[name]
        if not all((path / "rollout.h5").exists() and is_current(path) for path in paths):
            print(f"{name}: as before, its rollouts or their measures are missing")
            rows += [before[name]] if name in before else []
            continue
        step = step_of(run / name, own)
        row = {"name": name, "step_size": step.size, "step_integrator": step.integrator}
        if (run / name / "model.h5").exists():
            row["training_seconds"] = json.loads((run / name / "stage_seconds.json").read_text()).get("train")
            if own.training.horizons:
                row["horizon_errors"] = horizon_errors(run / name / "model.h5", own.training.horizons)
        seconds = (seconds_of(runs[paths[1]], paths[1], step, paths[1] / "ground_truth.h5") if timed else
                   before.get(name, {}).get("wall_seconds", math.nan))
        if math.isfinite(seconds):
            row["wall_seconds"] = rounded(seconds)
        flows = {path.name: measures_of(path) for path in paths}
        tested = [found for flow, found in flows.items() if run.name != "ladder" or flow != CHOICE]
        rows.append(row | combined(tested) | {"flows": flows})
    results.write_text(json.dumps({"rows": rows}, indent=1) + "\n")
    if run.name == "ladder":
        FIGURE.write_bytes(png(figure(rows)))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path)
    parser.add_argument("--seconds", action="store_true", help="measure the seconds of a turnover")
    given = parser.parse_args()
    main(given.run, given.seconds)
