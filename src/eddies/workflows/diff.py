"""`eddies diff`: print the settings in which two runs differ, and the numbers in which their reports differ."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Any

from eddies.io.hdf5 import in_files
from eddies.io.provenance import read_metrics
from eddies.parallel.communicator import Comm
from eddies.report.page import shown
from eddies.scene.layers import dotted
from eddies.scene.scene import load_scene

METRICS = Path("report") / "metrics.json"


def run(one: Path, other: Path, comm: Comm) -> None:
    """Print a line for each setting and each number that differs between two runs; all ranks call it."""
    lines = in_files(comm, one, lambda: diff_lines(one, other))
    if comm.rank == 0:
        sys.stdout.write("".join(f"{line}\n" for line in lines))


def diff_lines(one: Path, other: Path) -> list[str]:
    """Return the lines of two tables of differences: of the settings, defaults included, and of the numbers. The second
    table also has the ratio second / first."""
    runs = one, other
    settings = [dict(dotted(tomllib.loads(load_scene(path / "scene.toml").to_toml()))) for path in runs]
    lines = [*table("setting", settings, runs), ""]
    if missing := [path for path in runs if not (path / METRICS).is_file()]:
        return [*lines, f"no numbers to compare; run {' and '.join(f'`eddies report {path}`' for path in missing)}"]
    metrics = [dict(dotted(read_metrics(path / METRICS))) for path in runs]
    numbers = [{key: value for key, value in each.items() if isinstance(value, int | float)} for each in metrics]
    return [*lines, *table("number", numbers, runs, ratio=True)]


def table(title: str, columns: list[dict[str, Any]], runs: tuple[Path, Path], ratio: bool = False) -> list[str]:
    """Return the lines of a table of the values that differ between two runs, or one line if none differs.

    `title` names the kind of the values, and `columns` holds the values of each run by key. A missing value is shown as
    "-". If `ratio` is true, a last column has the ratio second / first.
    """
    rows = [(title, *map(str, runs), "ratio" if ratio else "")]
    for key in dict.fromkeys([*columns[0], *columns[1]]):
        first, second = (column.get(key) for column in columns)
        if first != second:
            quotient = f"{second / first:.3g}" if ratio and first and second is not None else ""
            rows.append((key, *("-" if value is None else shown(value) for value in (first, second)), quotient))
    if len(rows) == 1:
        return [f"no {title} differs"]
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return ["  ".join([f"{row[0]:{widths[0]}}", f"{row[1]:>{widths[1]}}", f"{row[2]:>{widths[2]}}", row[3]]).rstrip()
            for row in rows]
