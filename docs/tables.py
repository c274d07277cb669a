"""Writes the tables of README and docs from the results beside this file.

    .venv/bin/python docs/tables.py

A table stands between two comments. The first names the comparison in docs/results, the columns, and the rows with the
words for them; a row `floor` is the truth's own, a row `simulation` has the cost of the direct simulation, and a line
`*` takes all rows under their names:

    <!-- table of compare-small: wall_seconds velocity_error_half
    learned: the default
    floor: two samples of the true particles
    -->
    <!-- end of table -->

The numbers of a run stand likewise, a row each, taken from its `metrics.json` as RUN.json in docs/results:

    <!-- numbers of hit-small
    resolution k_max eta = {ground_truth[kmax_eta]:.2f}
    -->
    <!-- end of numbers -->
"""

import json
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eddies.measures import MEASURES

HERE = Path(__file__).parent
PAGES = (HERE.parent / "README.md", *sorted(HERE.glob("*.md")), *sorted(HERE.glob("notes/*.md")))
TABLE = re.compile(r"(<!-- table of ([\w-]+): ([^\n]*)\n(.*?)-->\n).*?(?=<!-- end of table -->)", re.DOTALL)
NUMBERS = re.compile(r"(<!-- numbers of ([\w-]+)\n(.*?)-->\n).*?(?=<!-- end of numbers -->)", re.DOTALL)
WORDS = MEASURES | {"wall_seconds": "seconds a turnover", "core_seconds": "core seconds a turnover",
                    "training_seconds": "training (s)",
                    "break_even_simulation": "cheaper than the direct simulation after (T)",
                    "break_even_grid": "cheaper than the best grid after (T)", "time_step": "step",
                    "step_integrator": "integrator", "step_size": "step", "step_seconds": "search (s)",
                    "step_error_twice": "error with twice the step", "step_error": "error",
                    "step_error_half": "with half"}
FLOOR, SIMULATION = "floor", "simulation"


def written(page: str) -> str:
    """A page with its tables as the results are now. KeyError where a table names what is not there."""
    page = TABLE.sub(lambda found: found[1] + table(*found.groups()[1:]), page)
    return NUMBERS.sub(lambda found: found[1] + numbers(*found.groups()[1:]), page)


def table(comparison: str, columns: str, rows: str) -> str:
    """The lines of one table."""
    record = json.loads((HERE / "results" / f"{comparison}.json").read_text(encoding="utf-8"))
    results, keys = {row["name"]: row for row in record["rows"]}, columns.split()
    # Any complete row has the floors, which are the truth's.
    results[FLOOR] = {key.removesuffix("_floor"): value for row in record["rows"] for key, value in row.items()
                      if key.endswith("_floor") and value is not None}
    results[SIMULATION] = {"wall_seconds": record.get("simulation_seconds")}
    lines = ["| |" + "".join(f" {WORDS[key]} |" for key in keys), "|---|" + "---|" * len(keys)]
    asked = [] if rows.strip() == "*" else [row.split(": ", 1) for row in rows.strip().splitlines()]
    for name, words in asked or [(row["name"], f"`{row['name']}`") for row in record["rows"]]:
        lines.append(f"| {words} |" + "".join(f" {number(results[name], key)} |" for key in keys))
    return "\n".join(lines) + "\n"


def numbers(run: str, rows: str) -> str:
    """The lines of the numbers of a run."""
    record = json.loads((HERE / "results" / f"{run}.json").read_text(encoding="utf-8"))
    lines = ["| quantity | value |", "|---|---|"]
    for row in rows.strip().splitlines():
        words, pattern = row.rsplit(" = ", 1)
        lines.append(f"| {words} | {pattern.format(**record)} |")
    return "\n".join(lines) + "\n"


def number(row: Mapping[str, Any], key: str) -> str:
    """Two digits, or as many as the standard deviation determines; ratios to three digits after the point; steps to
    three digits and their errors to four; a word as it is; empty without a number."""
    value, spread = row.get(key), row.get(f"{key}_spread")
    if value is None or isinstance(value, str):
        return value or ""
    if key.startswith("step_error"):
        return f"{value:.4f}" if value >= 1e-3 else f"{value:.1e}"
    if key == "step_size":
        return f"{value:.3g}"
    if key.endswith("_ratio"):
        return f"{value:.3f}" + (f" ± {spread:.3f}" if spread is not None else "")
    if spread is None or spread == 0:
        return f"{float(f'{value:.2g}'):g}"
    # To the first digit of the deviation, or to its second behind a 1.
    places = -math.floor(math.log10(spread / 1.95))
    if places > 5:
        return f"{value:.1e} ± {spread:.0e}"
    return f"{value:.{max(places, 0)}f} ± {spread:.{max(places, 0)}f}"


if __name__ == "__main__":
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        if (new := written(text)) != text:
            path.write_text(new, encoding="utf-8")
            print(path.name)
