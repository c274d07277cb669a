"""Writes the tables of README and docs, results/steps.csv and ladder/choices.csv, from the results beside this file.

    .venv/bin/python docs/tables.py [compare-hit=runs/compare-hit ...]

First the results of the runs that are given as NAME=RUN are kept, as docs/results/NAME.json.

A table stands between two comments. The first names the comparison in docs/results, the columns, and the rows with the
words for them; a row `floor` is the truth's own, and a row `simulation` has the cost of the direct simulation. Without
rows the table has all of the comparison. A row OTHER/NAME is that of another comparison. A row `heads` first gives the
head of the words; words of several cells are separated by ` | `:

    <!-- table of compare-small: wall_seconds velocity_error_half
    heads: model | needs
    learned: the default | pairs
    floor: two samples of the true particles |
    other/learned: the same of `other` | pairs
    -->
    <!-- end of table -->

The numbers of a run stand likewise, a row each:

    <!-- numbers of hit-small
    resolution k_max eta = {ground_truth[kmax_eta]:.2f}
    -->
    <!-- end of numbers -->
"""

import csv
import io
import json
import math
import re
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eddies.measures import MEASURES

HERE = Path(__file__).parent
PAGES = (HERE.parent / "README.md", *sorted(HERE.glob("*.md")))
TABLE = re.compile(r"(<!-- table of ([\w.-]+): ([^\n]*)\n(.*?)-->\n).*?(?=<!-- end of table -->)", re.DOTALL)
NUMBERS = re.compile(r"(<!-- numbers of ([\w-]+)\n(.*?)-->\n).*?(?=<!-- end of numbers -->)", re.DOTALL)
WORDS = MEASURES | {"acceleration_error": "acceleration error", "spectrum_error": "spectrum error",
                    "velocity_kl_half": "KL velocity at T/2", "acceleration_kl_half": "KL acceleration at T/2",
                    "count_variance": "variance of counts", "plane_difference": "error of a plane",
                    "wall_seconds": "seconds a turnover", "core_seconds": "core seconds a turnover",
                    "training_seconds": "training (s)", "time_step": "step", "turnovers": "turnovers",
                    "forced_energy_ratio": "energy", "forced_spectrum_error": "spectrum error",
                    "step_integrator": "integrator", "step_size": "step", "step_seconds": "search (s)",
                    "step_error_twice": "error with twice the step", "step_error": "error",
                    "step_error_half": "with half",
                    "energy_98_ratio": "energy at 98", "rms_98": "rms at 98",
                    "energy_171_ratio": "energy at 171", "rms_171": "rms at 171"}
# What is kept of the metrics of a comparison; of other runs all is kept.
KEPT = "name", "title", "machine", "flow", "simulation_seconds", "rows", "summary"
HEADS, FLOOR, SIMULATION = "heads", "floor", "simulation"
# The choices that the paper leaves open: the file has the words, and these columns of results.
CHOICES = HERE / "ladder" / "choices.csv"
CHOICE_COLUMNS = "acceleration_error", "velocity_error_half", "velocity_error_end", "count_variance"
# The steps that the search found: comparisons with their rows, and columns of the file.
STEPS = HERE / "results" / "steps.csv"
STEPS_OF = "hit-small", "compare-small", "compare-hit", "compare-coarse", "compare-256"
STEP_COLUMNS = ("step_integrator", "step_size", "step_error_twice", "step_error", "step_error_half", "wall_seconds",
                "step_seconds")


def keep(name: str, run: Path) -> None:
    """Write the results of a run that has been reported beside the others. Rows of forced rollouts get their averages
    over the second half of the time, relative to the stationary flow, with the standard error as the spread."""
    metrics = json.loads((run / "report/metrics.json").read_text(encoding="utf-8"))
    for row in metrics.get("rows", ()):
        if forced := metrics.get("forced", {}).get(row["name"]):
            energy, spectrum = forced["energy"], forced["spectrum_error"]
            row |= {"turnovers": metrics["rollouts"][row["name"]]["turnovers"],
                    "forced_energy_ratio": energy["model"] / energy["stationary flow"],
                    "forced_energy_ratio_spread": energy["standard error"] and (  # None of too short a rollout
                        energy["standard error"] / energy["stationary flow"]),
                    "forced_spectrum_error": spectrum["model"],
                    "forced_spectrum_error_spread": spectrum["standard error"]}
    found = {key: metrics[key] for key in KEPT} if "rows" in metrics else metrics
    (HERE / "results" / f"{name}.json").write_text(json.dumps(found, indent=2) + "\n", encoding="utf-8")


def written(page: str) -> str:
    """A page with its tables as the results are now. KeyError where a table names what is not there."""
    page = TABLE.sub(lambda found: found[1] + table(*found.groups()[1:]), page)
    return NUMBERS.sub(lambda found: found[1] + numbers(*found.groups()[1:]), page)


def table(comparison: str, columns: str, rows: str) -> str:
    """The lines of one table."""
    record = record_of(comparison)
    results, keys = {row["name"]: row for row in record["rows"]}, columns.split()
    asked = [row.split(": ", 1) for row in rows.strip().splitlines()] or [(name, f"`{name}`") for name in results]
    # Any complete row has the floors, which are the truth's.
    results[FLOOR] = {key.removesuffix("_floor"): value for row in record["rows"] for key, value in row.items()
                      if key.endswith("_floor") and value is not None}
    results |= {SIMULATION: {"wall_seconds": record.get("simulation_seconds")}}
    heads = f" {asked.pop(0)[1]} " if asked[0][0] == HEADS else " "
    for other in {name.partition("/")[0] for name, _ in asked if "/" in name}:
        results |= {f"{other}/{row['name']}": row for row in record_of(other)["rows"]}
    rule = "|---|" + "---|" * (heads.count("|") + len(keys))
    lines = [f"|{heads}|" + "".join(f" {WORDS[key]} |" for key in keys), rule]
    for name, words in asked:
        lines.append(f"| {words} |" + "".join(f" {number(results[name], key)} |" for key in keys))
    return "\n".join(lines) + "\n"


def steps() -> str:
    """The lines of the table of all steps."""
    return as_csv([["scene", "variant", *(WORDS[key] for key in STEP_COLUMNS)],
                   *([scene, row["name"], *(number(row, key) for key in STEP_COLUMNS)]
                     for scene in STEPS_OF for row in record_of(scene)["rows"])])


def choices() -> str:
    """The lines of the table of choices. Its first three columns, variant and words, are those of the file."""
    heads, *rows = csv.reader(CHOICES.read_text(encoding="utf-8").splitlines())
    found = {row["name"]: row for row in record_of("choices")["rows"]}
    return as_csv([[*heads[:3], *(WORDS[key] for key in CHOICE_COLUMNS)],
                   *([*row[:3], *(number(found[row[0]], key) for key in CHOICE_COLUMNS)] for row in rows)])


def as_csv(rows: list[list[str]]) -> str:
    """Rows as CSV."""
    written = io.StringIO()
    csv.writer(written, lineterminator="\n").writerows(rows)
    return written.getvalue()


def record_of(name: str) -> dict[str, Any]:
    """What docs/results has under this name."""
    return json.loads((HERE / "results" / f"{name}.json").read_text(encoding="utf-8"))


def numbers(run: str, rows: str) -> str:
    """The lines of the numbers of a run."""
    record = record_of(run)
    lines = ["| quantity | value |", "|---|---|"]
    for row in rows.strip().splitlines():
        words, pattern = row.rsplit(" = ", 1)
        lines.append(f"| {words} | {pattern.format(**record)} |")
    return "\n".join(lines) + "\n"


def number(row: Mapping[str, Any], key: str) -> str:
    """Two digits, or as many as the standard deviation determines; ratios to three digits after the point; steps to
    three digits and their errors to four; a word as it is; empty without a number. Times of a busy machine are
    marked."""
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
        return f"{float(f'{value:.2g}'):g}" + (" (busy)" if key == "wall_seconds" and row.get("busy") else "")
    # To the first digit of the deviation, or to its second behind a 1.
    places = -math.floor(math.log10(spread / 1.95))
    if places > 5:
        return f"{value:.1e} ± {spread:.0e}"
    return f"{value:.{max(places, 0)}f} ± {spread:.{max(places, 0)}f}"


if __name__ == "__main__":
    for name, run in (argument.split("=") for argument in sys.argv[1:]):
        keep(name, Path(run))
    for path in PAGES:
        text = path.read_text(encoding="utf-8")
        if (new := written(text)) != text:
            path.write_text(new, encoding="utf-8")
            print(path.name)
    STEPS.write_text(steps(), encoding="utf-8")
    CHOICES.write_text(choices(), encoding="utf-8")
