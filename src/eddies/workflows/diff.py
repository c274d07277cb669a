"""`eddies diff`: print the settings in which two runs differ, and the numbers in which their reports differ."""

import sys
import tomllib
from pathlib import Path
from typing import Any

from eddies.errors import UserError
from eddies.io.hdf5 import in_files
from eddies.io.provenance import read_metrics
from eddies.parallel.communicator import Comm
from eddies.report.page import shown
from eddies.scene.layers import dotted
from eddies.scene.scene import load_scene
from eddies.workflows.run_directory.work import newer_products

METRICS = Path("report") / "metrics.json"
OF_VARIANTS = "rollouts", "forced", "models", "steps"  # parts of metrics.json that hold a dict for each variant


Choice = tuple[Path, str | None]  # a run directory, and the name of a variant


def run(one: Choice, other: Choice, comm: Comm) -> None:
    """Print a line for each setting and each number that differs between two runs or variants; all ranks call it."""
    lines = in_files(comm, one[0], lambda: diff_lines(one, other))
    if comm.rank == 0:
        sys.stdout.write("".join(f"{line}\n" for line in lines))


def diff_lines(one: Choice, other: Choice) -> list[str]:
    """Return the lines of two tables of differences: of the settings, defaults included, and of the numbers. The second
    table also has the ratio second / first."""
    both = one, other
    for path, _ in both:
        if not (path / "scene.toml").is_file():
            raise UserError(f"{path}: is not a run, because it has no scene.toml; give the directories of two runs")
    titles = tuple(str(path if variant is None else path / variant) for path, variant in both)
    scenes = [load_scene(path / "scene.toml") for path, _ in both]
    for scene, (_, variant) in zip(scenes, both):
        scene.check_variants([] if variant is None else [variant])
    settings = [dict(dotted(tomllib.loads((scene if variant is None else scene.variant[variant]).to_toml())))
                for scene, (_, variant) in zip(scenes, both)]
    lines = [*table("setting", settings, titles), ""]
    if missing := dict.fromkeys(path for path, _ in both if not (path / METRICS).is_file()):
        return [*lines, f"no numbers to compare; run {' and '.join(f'`eddies report {path}`' for path in missing)}"]
    lines += [f"{path / METRICS}: is older than the products; run `eddies report {path}`"
              for path in dict.fromkeys(path for path, _ in both) if newer_products(path / METRICS)]
    metrics = [dict(dotted(numbers_of(*each))) for each in both]
    numbers = [{key: value for key, value in each.items() if isinstance(value, int | float)} for each in metrics]
    return [*lines, *table("number", numbers, titles, ratio=True)]


def numbers_of(path: Path, variant: str | None) -> dict[str, Any]:
    """Return the numbers of a report. If a variant is given, or if there is only one, its numbers have keys without its
    name, and those of other variants are left out."""
    found = read_metrics(path / METRICS)
    names = dict.fromkeys(name for key in OF_VARIANTS for name in found.get(key, {}))
    if variant is None and len(names) > 1:
        return found
    name = variant or next(iter(names), None)
    rows = [row for row in found.get("rows", ()) if row["name"] == name]
    return {**{key: value for key, value in found.items() if key not in (*OF_VARIANTS, "rows")},
            **{key: found[key].get(name, {}) for key in OF_VARIANTS if key in found}, "row": rows[0] if rows else {}}


def table(title: str, columns: list[dict[str, Any]], titles: tuple[str, ...], ratio: bool = False) -> list[str]:
    """Return the lines of a table of the values that differ between two runs, or one line if none differs.

    `title` names the kind of the values. `columns` holds the values of each run by key, and `titles` names the runs. A
    missing value is shown as "-". If `ratio` is true, a last column has the ratio second / first.
    """
    rows = [(title, *titles, "ratio" if ratio else "")]
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
