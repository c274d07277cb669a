"""What differs between two runs, for people: settings, and the numbers of their reports."""

from __future__ import annotations

import json
import sys
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from eddies.io.hdf5 import in_files
from eddies.parallel.communicator import Comm
from eddies.report.page import shown
from eddies.scene.scene import load_scene
from eddies.workflows.run_directory.work import leaves

METRICS = Path("report") / "metrics.json"


def run(one: Path, other: Path, comm: Comm) -> None:
    """Print a line for every setting and number that differs; all ranks call it."""
    lines = in_files(comm, one, lambda: list(diff_lines(one, other)))
    if comm.rank == 0:
        sys.stdout.write("".join(f"{line}\n" for line in lines))


def diff_lines(one: Path, other: Path) -> Iterator[str]:
    """First the settings, those of a scene's defaults included, then the numbers, with the second over the first."""
    yield from columns("setting", differing(*(settings(path) for path in (one, other))), one, other)
    yield ""
    if missing := [path for path in (one, other) if not (path / METRICS).is_file()]:
        yield f"no numbers to compare: {', '.join(f'`eddies report {path}`' for path in missing)} makes them"
    else:
        yield from columns("number", differing(*(numbers(path) for path in (one, other))), one, other, ratio=True)


def settings(directory: Path) -> dict[str, Any]:
    """Every key of the scene that was run, by its path; SceneError where there is none."""
    scene = tomllib.loads(load_scene(directory / "scene.toml").to_toml())
    return {".".join(keys): value for keys, value in leaves(scene)}


def numbers(directory: Path) -> dict[str, Any]:
    """Every number of the report, by section and key."""
    found = json.loads((directory / METRICS).read_text())
    return {".".join(keys): value for keys, value in leaves(found) if isinstance(value, int | float)}


def differing(one: Mapping[str, Any], other: Mapping[str, Any]) -> dict[str, tuple[Any, Any]]:
    """Both values of every key with two different ones, None where there is none."""
    return {key: (one.get(key), other.get(key)) for key in {**one, **other} if one.get(key) != other.get(key)}


def columns(title: str, found: Mapping[str, tuple[Any, Any]], one: Path, other: Path, ratio: bool = False) -> list[str]:
    """Lines of a table, or one that says that all is equal."""
    if not found:
        return [f"no {title} differs"]
    rows = [(title, str(one), str(other), "ratio" if ratio else "")]
    for key, values in found.items():
        known = ratio and None not in values and values[0] != 0
        rows.append((key, *("-" if value is None else shown(value) for value in values),
                     f"{values[1] / values[0]:.3g}" if known else ""))
    widths = [max(len(row[column]) for row in rows) for column in range(3)]
    return ["  ".join([f"{row[0]:{widths[0]}}", f"{row[1]:>{widths[1]}}", f"{row[2]:>{widths[2]}}", row[3]]).rstrip()
            for row in rows]
