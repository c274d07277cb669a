"""Writes the table of the ladder from its run: each rung on the flow of the choice and on those of the test.

    .venv/bin/python docs/ladder/table.py runs/ladder

The first realisation serves the choice, the others the test, whose mean and standard deviation stand in the table. It
also writes ../results/ladder.json and the figure ../paper/ladder.png: error at T over the cost of a turnover.
"""

import json
import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.report.figures import GUIDE, LOOKS, panels, png, styled
from eddies.scene.scene import load_scene
from eddies.workflows.measure import is_current, read
from eddies.workflows.variants import rollouts

HERE = Path(__file__).parent
#: The rungs that the line of the figure connects.
LINE = "paper", "wide", "together", "together-horizons", "local-pairs", "local", "resolved"
COLUMNS = {"acceleration_error": "a priori", "velocity_error_early": "t_η", "velocity_error_half": "T/2",
           "velocity_error_end": "T", "plane_difference": "field at T", "energy_ratio": "energy",
           "spectrum_error": "spectrum", "count_variance": "counts"}


def measures_of(directory: Path) -> dict[str, float | None]:
    """The measures of a rollout; None where it broke off."""
    found, _ = read(directory, MPI.COMM_SELF)
    numbers = found["rollout"] | found["accuracy"]
    return {name: numbers.get(name) for name in COLUMNS}


def cell(values: list[float | None]) -> str:
    """Mean and standard deviation, or how many rollouts broke off."""
    known = [value for value in values if value is not None]
    if len(known) < len(values):
        return f"{len(values) - len(known)} of {len(values)} broke off"
    return f"{np.mean(known):.3g}" + (f" ± {np.std(known, ddof=1):.1g}" if len(known) > 1 else "")


@styled
def figure(found: dict[str, dict]):
    """Velocity error at T over seconds a turnover: mean and standard deviation of the flows of the test."""
    drawn, axes = panels(1, 1, (7.0, 4.4))
    axis, points = axes[0, 0], {}
    for name, row in found.items():
        errors = [other["velocity_error_end"] for other in row["realisations"][1:]]
        if None not in errors and row["wall_seconds"]:
            points[name] = row["wall_seconds"], float(np.mean(errors)), float(np.std(errors, ddof=1))
    line = [name for name in LINE if name in points]
    axis.plot(*np.transpose([points[name][:2] for name in line]), color=GUIDE, linewidth=1, zorder=1)
    for name, (cost, error, spread) in points.items():
        colour, marker = LOOKS.get("none" if name == "no-force" else name, (GUIDE, "o"))
        named = name in line or name in LOOKS
        axis.errorbar(cost, error, spread, color=colour, marker=marker, markersize=6 if named else 4, linewidth=1)
        if named:
            axis.annotate(name, (cost, error), xytext=(6, 5), textcoords="offset points", fontsize=9)
    axis.errorbar([], [], [], color=GUIDE, marker="o", markersize=4, linestyle="none", label="other rungs (table)")
    axis.set(xscale="log", xlabel="seconds a turnover", ylabel="velocity error at T", ylim=(0, None))
    axis.legend()
    return drawn


def main(directory: Path) -> None:
    rows = json.loads((directory / "report" / "metrics.json").read_text())["rows"]
    costs, found = {row["name"]: row for row in rows}, {}
    for name, runs in rollouts(load_scene(directory / "scene.toml"), directory).items():
        if all(is_current(run) for run in runs):
            cost = {key: costs[name][key] for key in ("training_seconds", "time_step", "wall_seconds")}
            found[name] = cost | {"realisations": [measures_of(run) for run in runs]}
    (HERE.parent / "results" / "ladder.json").write_text(json.dumps(found, indent=1) + "\n")
    (HERE.parent / "paper" / "ladder.png").write_bytes(png(figure(found)))
    print(f"| rung | training (s) | seconds a turnover | T, choice | {' | '.join(COLUMNS.values())} |")
    print("|---" * (4 + len(COLUMNS)) + "|")
    for name, row in found.items():
        first, *others = row["realisations"]
        costs_shown = ("" if row[key] is None else f"{row[key]:.3g}" for key in ("training_seconds", "wall_seconds"))
        print(f"| `{name}` | {' | '.join(costs_shown)} | {cell([first['velocity_error_end']])} | "
              f"{' | '.join(cell([other[key] for other in others]) for key in COLUMNS)} |")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
