"""Figure of the error over the filter width in Kolmogorov lengths, from the results of several comparisons.

    .venv/bin/python docs/filter_width.py

It shows the variants of the same names in all comparisons, and the best coarse grids: those with the smallest error of
all that take no longer than the resolved velocity in the same run, once with exact modes of the flow at the start, once
with modes found in the velocities of the particles.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure
from pictures import save

from eddies.measures import MEASURES
from eddies.report.summary import in_symbols, is_stable
from eddies.report.figures import BLUE, FILTERED, GRID, LOOKS, legend_at_foot, letter, panels, styled

HERE = Path(__file__).parent
COMPARISONS = "small", "hit", "coarse", "256"
DRAWN = ("velocity_error_half", "acceleration_kl")
# Label, colour and marker of the variants.
MARKERS = {"resolved": ("resolved", *LOOKS["resolved"]),
           "grid": ("best grid", BLUE, GRID),
           "grid-particles": ("best grid, from particles", BLUE, GRID),
           "paper": ("paper", *LOOKS["paper"]),
           "transport-velocity": ("transport-velocity", *LOOKS["transport-velocity"]),
           "local": ("local", *LOOKS["local"]), "no-force": ("no-force", *LOOKS["none"])}

Row = Mapping[str, Any]


def width_of(result: Mapping[str, Any]) -> float:
    """d/eta of a comparison."""
    return result["flow"]["filter_width"] / result["flow"]["kolmogorov_length"]


def best_grid(rows: Mapping[str, Row], measure: str, of_particles: bool) -> Row | None:
    """The grid with the smallest error of those that take no longer than the resolved velocity. `of_particles`: of
    those that start from the particles."""
    rivals = [row for row in rows.values() if row["name"].startswith("grid-")
              and row["name"].endswith("-particles") == of_particles
              and None not in (row[measure], row["wall_seconds"])
              and row["wall_seconds"] <= rows["resolved"]["wall_seconds"]]
    return min(rivals, key=lambda row: row[measure], default=None)


def points(results: Iterable[Mapping[str, Any]], name: str, measure: str) -> list[tuple[float, float, float, str]]:
    """d/eta, error, its spread and the name of the variant, for every comparison; the error is NaN where a comparison
    lacks the variant or its rollout broke off."""
    found = []
    for result in results:
        rows = {row["name"]: row for row in result["rows"] if is_stable(row)}
        row = best_grid(rows, measure, name != "grid") if name.startswith("grid") else rows.get(name)
        if row is None or row[measure] is None:
            found.append((width_of(result), math.nan, 0.0, name))
        else:
            found.append((width_of(result), row[measure], row.get(f"{measure}_spread") or 0.0, row["name"]))
    return sorted(found)


@styled
def drawn(results: Sequence[Mapping[str, Any]]) -> Figure:
    """A panel for each measure."""
    figure, axes = panels(1, len(DRAWN), (4.0, 3.4))
    for axis, measure in zip(axes.flat, DRAWN):
        for name, (words, colour, marker) in MARKERS.items():
            width, error, spread, _ = zip(*points(results, name, measure))
            hollow = {"linestyle": "--", "markerfacecolor": "white"} if name == "grid-particles" else {}
            axis.errorbar(width, error, [[min(s, 0.9 * e) for s, e in zip(spread, error)], spread], color=colour,
                          marker=marker, markersize=6, capsize=2, elinewidth=1, label=words, **hollow)
        if f"{measure}_floor" in MEASURES:
            width, floor, *_ = zip(*points(results, "resolved", f"{measure}_floor"))
            axis.plot(width, floor, color=FILTERED, linestyle=":", label="two true samples")
        axis.set(xscale="log", yscale="log", xlabel=r"width of the filter $d/\eta$",
                 ylabel=in_symbols(MEASURES[measure]))
        ticks = sorted(map(width_of, results))
        axis.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
        axis.minorticks_off()
    letter(axes.flat)
    legend_at_foot(figure, axes.flat[-1])
    return figure


if __name__ == "__main__":
    given = [json.loads((HERE / f"results/compare-{name}.json").read_text()) for name in COMPARISONS]
    for each in DRAWN:
        for start in "grid", "grid-particles":
            print(each, *(f"d/eta {at:.1f}: {name} {error:.3g}" for at, error, _, name in points(given, start, each)))
    save(HERE / "error-over-filter-width.png", drawn(given))
