"""The report of a run: pages with the figures of the paper, and a file with the numbers as JSON.

Both are made from the products of the run. Every product is optional: a page has sections for the products that exist.
All ranks measure a rollout together. Each page is made, drawn and written by one rank.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import logging
import os
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.velocity_gradients import vorticity
from eddies.analysis.tracer_statistics import tracer_statistics
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, in_files, open_product, read_attributes, read_table
from eddies.io.provenance import (others_trained_on, product_attributes, product_provenance, read_json,
                                  read_provenance)
from eddies.io.trajectories import Trajectory
from eddies.measures import finite
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import MAKER_OF
from eddies.report import (figures, forced, ground_truth, kernel, model, reconstruction, rollout, stationary, steps,
                           tracers)
from eddies.report import variants as table_of_variants
from eddies.report.page import Metric, RunRecord, Section, arranged, shown, write_page
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.workflows.problems import directory_problems
from eddies.workflows.product_warnings import doubts, not_finite, old_products
from eddies.workflows.run_directory.work import read_stage_seconds
from eddies.workflows.variant_rows import (COLUMNS, ROLLOUT, add_break_even, machine, notes, numbers, rows_of,
                                           simulation_seconds)
from eddies.workflows.variants import rollouts

if TYPE_CHECKING:
    from eddies.analysis.rollout import Rollout
    from eddies.workflows.rollout.measured import MeasuredRollout  # needs torch

log = logging.getLogger("eddies")

ROLLOUT_COST = {"seconds_per_step": "rollout: seconds of a step (median, without storing)",
                "particles": "particles of the rollout",
                "ranks": "ranks of the rollout"}
SIMULATION = "dns_seconds_per_turnover"
SOURCE_OF_TRACKS = ("{in_file} measured tracks from {file}, on average {mean_count:.0f} in a frame; {complete} are in "
                    "all frames. Fields are reconstructed from them by least squares. The dissipation rate is the "
                    "value of the literature for this velocity and integral scale.")
MAIN_PAGE = 3  # time to make the main page, divided by that of another page; a round takes as long as the main page
Row = dict[str, Any]


@dataclass
class Page:
    """A page of the report, made by one rank.

    directory: run directory of the products. seconds: wall seconds by stage. provenance: provenance by kind of product.
    not_finite: a sentence on each product with numbers that are not finite. cost: the metrics of cost.
    """

    directory: Path
    seconds: dict[str, float]
    provenance: dict[str, dict[str, Any]] = field(default_factory=dict)
    not_finite: list[str] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)
    cost: list[Metric] = field(default_factory=list)
    stationary: StationarySpan | None = None
    sections: list[Section] = field(default_factory=list)

    @property
    def simulation_seconds(self) -> float | None:
        """Wall seconds per turnover of the direct simulation; None without one, or if it took no step."""
        return next((metric.value for metric in self.cost if metric.key == SIMULATION), None)


def _draw(sections: Sequence[Section]) -> None:
    """Draw the figures of sections, then free them. A figure that fails is left out with a warning."""
    for illustration in (each for section in sections for each in section.illustrations):
        try:
            illustration.png = figures.png(illustration.figure)
        except Exception as error:  # an error of matplotlib or its settings must not lose the rest of the report
            log.warning("report: a figure is left out, because drawing %s fails (%s: %s)", illustration.name,
                        type(error).__name__, error)
        illustration.figure = None


@dataclass(frozen=True)
class Report:
    """The pages of the report on a run directory.

    scene_name: name of the scene. runs: directories of the rollouts of each variant, by name. pages: run directory of
    each variant that was run, by name; the main page comes first. If no variant has a rollout, there is one page, of
    the run directory itself, under the name "". output: directory of the reports; None: "report" in each directory.
    old: products that were made with other settings than those of the last job, as `old_products`.
    """

    directory: Path
    scene_name: str
    runs: Mapping[str, Sequence[Path]]
    pages: Mapping[str, Path]
    output: Path | None = None
    old: Mapping[Path, Sequence[str]] = field(default_factory=dict)

    @property
    def main(self) -> str:
        """The variant of the main page."""
        return next(iter(self.pages))

    def measured(self, name: str) -> list[Path]:
        """Return the directories of the rollouts of a variant."""
        return list(filter(_has_rollout, self.runs[name] if name else [self.directory]))

    def report_of(self, page: Path) -> Path:
        """Return the directory of the report about the run directory `page`."""
        return page / "report" if self.output is None else self.output / page.relative_to(self.directory)

    def links(self, page: Path) -> list[tuple[str, str]]:
        """Return the titles and relative paths of the other pages, for links on the page of the run directory
        `page`."""
        found = [] if page == self.directory else [(f"all of {self.scene_name}", self.directory)]
        found += [(name, where) for name, where in self.pages.items() if where not in (page, self.directory)
                  and not (page == self.directory and name == self.main)]
        return [(title, os.path.relpath(self.report_of(where) / "index.html", self.report_of(page)))
                for title, where in found]


def _has_rollout(directory: Path) -> bool:
    return (directory / ROLLOUT).exists()


def _plan(directory: Path, chosen: Sequence[str] = (), output: Path | None = None) -> tuple[Scene | None, Report]:
    """Return the scene of a run directory and the pages to make. The scene is None if it cannot be read.

    The main page shows the first variant in the list `chosen` that was run. If none of them was run, it shows the first
    variant of the scene that was run with the settings of the scene or, if there is none, with others.
    """
    scene, runs, old = None, {}, {}
    with contextlib.suppress(SceneError):
        scene = load_scene(directory / "scene.toml")
    if scene is not None:
        scene.check_variants(chosen)
        old = old_products(scene, directory)
        if scene.simulation is not None:
            runs = {name: [*scenes] for name, scenes in rollouts(scene, directory).items()}
    ran = {name: first for name, (first, *_) in runs.items() if _has_rollout(first)}
    present = [name for name, first in ran.items() if not old.get(first / ROLLOUT)]
    main = next((name for name in (*chosen, *present, *ran) if name in ran), "")
    return scene, Report(directory, scene.name if scene else "", runs, {main: ran.get(main, directory), **ran}, output,
                         old)


def run(directory: str | Path, comm: Comm, variants: Sequence[str] = (), stop: StopRequest | None = None,
        output: Path | None = None) -> None:
    """Write report/index.html, report/figures/*.png and report/metrics.json of a run directory; all ranks call it.

    If `output` is given, the files are written there, and the reports of variants in directories below it.

    The page of a scene with variants begins with the table of the variants. The details of one variant follow: the
    first variant in `variants` that was run, or else the first variant of the scene that was run. Each variant that was
    run also has a page of its own.

    Raises ProductError if the directory holds no product or a damaged one, or if the report cannot be written. Raises
    SceneError if `variants` names an unknown variant, and Stopped, before any page is written, if `stop` requests it.
    """
    directory, stop = Path(directory), stop or StopRequest(comm)
    for problem in directory_problems(("report",), comm, directory) if output is None else ():
        raise SceneError(problem)
    scene, report = in_files(comm, directory, lambda: _plan(directory, variants, output))
    alone = comm.Split(comm.rank)
    try:
        made, found = _make(report, comm, alone, stop)
        own = [page for page in made.values() if page.directory != directory]
        on_all_ranks(comm, lambda: in_files(alone, directory, lambda: [
            _write(report, page, page.directory) for page in own]), ProductError)
        for name, where in report.pages.items():
            if where != directory:
                log.info("report: variant %s: %s", name, report.report_of(where) / "index.html")
        text = scene.to_toml() if scene is not None and scene.variant else ""
        in_files(comm, report.report_of(directory), lambda: _write_main(
            report, made[report.main], *_compare(scene, report, made[report.main], found, comm.size, alone), text))
    finally:
        alone.Free()


def sections_of(directory: Path, alone: Comm) -> list[Section]:
    """Make all sections of the main page of a run directory on one rank, with figures that are not yet drawn."""
    scene, report = _plan(directory)
    report = replace(report, pages={report.main: report.pages[report.main]})
    made, found = _make(report, alone, alone, StopRequest(alone), draw=False)
    page = made[report.main]
    return [*_compare(scene, report, page, found, 1, alone)[0], *page.sections]


def _make(report: Report, comm: Comm, alone: Comm, stop: StopRequest,
          draw: bool = True) -> tuple[dict[str, Page], dict[str, list[Row]]]:
    """Make the pages. Return the pages of this rank, and the `numbers` of all rollouts, by name of the variant.

    All ranks measure each rollout together, and the rank that makes the variant's page collects the results. Then each
    rank makes its pages, in rounds (`_makers`). A variant has no numbers if one of its rollouts is missing. Raises
    Stopped, after the rollouts of a variant or after a round, if `stop` requests it.
    """
    names = list(report.pages) + [name for name in report.runs if name not in report.pages]
    (makers, rounds), made, found, truths, scanned = _makers(names, comm.size), {}, {}, {}, {}
    with ExitStack() as files:
        measured: dict[str, list[MeasuredRollout]] = {name: [] for name in names}
        for name in names:
            for where in report.measured(name):
                from eddies.workflows.rollout.measured import open_rollout  # needs torch
                opened = on_all_ranks(comm, lambda where=where: files.enter_context(open_rollout(where, alone)),
                                      ProductError)
                shown = where == report.pages.get(name)
                opened.measure(comm, makers[name], shown, shown and name == report.main, truths)
                measured[name].append(opened)
            stop.check()

        def make(name: str) -> None:
            if name in report.pages:
                page = made[name] = read_page(report.pages[name], alone, next(iter(measured[name]), None), scanned,
                                              report.old, main=name == report.main)
                if draw:
                    _draw(page.sections)
            if report.main and len(measured[name]) == len(report.runs[name]):
                found[name] = [numbers(each) for each in measured[name]]
            for each in measured[name]:
                each.forget()

        for turn in range(max(rounds.values()) + 1):
            own = [name for name in names if (makers[name], rounds[name]) == (comm.rank, turn)]
            on_all_ranks(comm, lambda: [in_files(alone, report.directory, lambda: make(name)) for name in own],
                         ProductError)
            stop.check()
    return made, {name: each for part in comm.allgather(found) for name, each in part.items()}


def _makers(names: Sequence[str], ranks: int) -> tuple[dict[str, int], dict[str, int]]:
    """Return two mappings by name of a page: the rank that makes the page, and the round in which this rank makes it.

    The first page is the main page. It takes about as long as three other pages; each round takes as long.
    """
    makers, rounds, load = {}, {}, [0] * ranks
    for number, name in enumerate(names):
        rank = makers[name] = load.index(min(load))
        rounds[name] = load[rank] // MAIN_PAGE
        load[rank] += 1 if number else MAIN_PAGE
    return makers, rounds


def read_page(directory: Path, alone: Comm, measured: MeasuredRollout | None, scanned: dict[Path, str],
              old: Mapping[Path, Sequence[str]], main: bool) -> Page:
    """Read the products of a run directory and return its page. The figures are not drawn.

    scanned: results of `not_finite` by file; new results are added. old: see `Report`. main: whether this is the main
    page, which shows everything. Other pages have fewer figures, and no sections on products that are links to other
    directories.
    """
    page = Page(directory, read_stage_seconds(directory))
    readers = {
        "ground_truth": _ground_truth_sections,
        "kernel": lambda file: [kernel.section(read_json(file, "description")["support"], **{
            name: read_table(file, name) for name in ("kernels", "slices", "errors")})],
        "reconstruction": lambda file: [reconstruction.section(
            read_attributes(file, "about"), read_table(file, "errors_over_time"),
            read_table(file, "errors_of_fields") if "errors_of_fields" in file else {}, _middle_plane(file))],
        "model": lambda file: [_model_section(file, page, main)],
        "step": lambda file: [steps.section(read_attributes(file, "found"), {
            name: read_table(file, f"trials/{name}") for name in file["trials"]})],
        "rollout": lambda file: _rollout_sections(measured.rollout, page, main)}
    for kind in MAKER_OF:
        path = directory / f"{kind}.h5"
        if not path.exists():
            continue
        with open_product(alone, path, kind) as file:
            page.provenance[kind] = read_provenance(file)
            if path.resolve() not in scanned:
                scanned[path.resolve()] = not_finite(file, kind)
            if found := scanned[path.resolve()]:
                page.not_finite.append(found)
            page.cost += _cost(file, kind)
            if kind == "ground_truth" and "stationary" in file:
                with contextlib.suppress(ProductError):  # the section on stationary turbulence shows the error
                    page.stationary = read_stationary_span(file)
            if main or not path.is_symlink():
                page.sections += _sections_or_notice(kind, page, lambda: readers[kind](file))
    if not page.provenance:
        raise ProductError(f"{directory}: holds none of {', '.join(f'{kind}.h5' for kind in MAKER_OF)}; "
                           "run `eddies dns SCENE` first")
    page.warnings = [*doubts(directory, page.provenance, old), *page.not_finite]
    page.sections = arranged([*page.sections, _cost_section(page)])
    return page


def _sections_or_notice(kind: str, page: Page, read: Callable[[], list[Section]]) -> list[Section]:
    """Return the sections on a product. If numbers that are not finite prevent this, return one section with a
    notice."""
    try:
        return read()
    except (ValueError, OverflowError) as error:  # NaN or infinity in the limits of a figure, a PDF or a count
        if not page.not_finite:
            raise
        title = kind.replace("_", " ").capitalize()
        return [Section(kind, title, notices=[f"Not shown ({error}): {'; '.join(page.not_finite)}"])]


def read_stationary_span(file: File) -> StationarySpan:
    """Return the span of an open ground_truth.h5 over which its stationary state is averaged.

    Raises ProductError if the span holds fewer than three samples.
    """
    span, scene = read_attributes(file, "stationary"), tomllib.loads(read_provenance(file)["scene"])
    forced_below = scene["forcing"]["wavenumber"] if "forcing" in scene else 0.0
    try:
        return StationarySpan(read_table(file, "statistics"), read_table(file, "spectra_of_statistics")["energy"],
                              read_attributes(file, "reference")["viscosity"], span["start"], span["end"], forced_below)
    except ValueError as error:
        raise ProductError(f"{file.filename}: {error}; raise [spin_up] stationary and run `eddies dns` again") from None


def _ground_truth_sections(file: File) -> list[Section]:
    reference, statistics = read_attributes(file, "reference"), read_table(file, "statistics")
    traced = "released_at" in reference
    name = "filtered" if traced else "final"
    velocity = FieldSeries(file, name).read(-1, "velocity")
    middle = velocity.shape[1] // 2
    planes = {"velocity": velocity[0, middle], "vorticity": np.linalg.norm(vorticity(velocity), axis=0)[middle]}
    spectra = read_table(file, "spectra" if traced else "spectra_of_statistics")
    if not traced:
        spectra["energy"] = spectra["energy"][-1:]
    if not np.any(spectra["energy"]):
        return [Section("ground_truth", "Ground truth", notices=["The flow is at rest: its velocity is zero."])]
    measured = "tracks" in file
    source = SOURCE_OF_TRACKS.format(**read_attributes(file, "tracks")) if measured else "Direct numerical simulation."
    sections = [ground_truth.section(statistics, spectra, reference, planes, name, source)]
    if "stationary" in file:
        try:
            sections.append(stationary.section(statistics, read_stationary_span(file)))
        except ProductError as error:
            sections.append(Section("stationary", "Stationary turbulence", notices=[str(error)]))
    if "particles/tracers" in file:
        power = read_attributes(file, "forcing")["injection_rate"] if "forcing" in file else 0.0
        found = tracer_statistics(Trajectory(file, "tracers"), spectra, reference["spacing"])
        scene = tomllib.loads(read_provenance(file)["scene"])
        filtered = scene.get("tracks", scene.get("tracers", {})).get("filtered", True)
        filtered |= measured and bool(file["tracks"].attrs.get("traced", False))
        sections.append(tracers.section(found, reference, None if measured else power, filtered))
    return sections


def _middle_plane(file: File) -> np.ndarray | None:
    """Return u_x in the plane z = pi of the last reconstruction; None if the velocity is not stored."""
    series = FieldSeries(file, "reconstructed")
    middle = series.cells // 2
    return series.read(-1, "velocity", middle, middle + 1)[0, 0] if "velocity" in series.variables else None


def _model_section(file: File, page: Page, main: bool) -> Section:
    provenance = page.provenance["model"]
    tables = {name: read_table(file, name) if name in file else None for name in (
        "a_priori", "acceleration_sample", "density_rate_sample", "history", "source_a_priori")}
    source, others = provenance.get("source"), others_trained_on(provenance)
    if source and "truths" in source:
        others = [path if reached is None else f"{path} (M_t = {reached:.3f})"
                  for path, reached in source["truths"].items()]
    part = model.section(read_json(file, "description"), tables["a_priori"], tables["acceleration_sample"],
                         tables["density_rate_sample"], tables["history"] if main else None,
                         source and source["path"], others)
    if source and tables["source_a_priori"] is not None:
        part.metrics += model.source_metrics(provenance["mach_turbulent"], tables["a_priori"],
                                             source["mach_turbulent"], tables["source_a_priori"])
    return part


def _rollout_sections(measured: Rollout, page: Page, main: bool) -> list[Section]:
    sections = [rollout.section(measured, main)]
    if measured.forced and page.stationary is not None and len(measured.truth.times):
        sections.append(forced.section(measured, page.stationary))
    return sections


def _cost(file: File, kind: str) -> list[Metric]:
    """Return metrics of the cost of the steps of a simulation or rollout; empty for other products."""
    if kind == "ground_truth" and "tracks" in file:
        return []
    if kind == "ground_truth":
        statistics, turnover = read_table(file, "statistics"), file["reference"].attrs["eddy_turnover_time"]
        seconds = float(np.median(statistics["seconds_per_step"]))
        elapsed = np.diff(statistics["time"])
        steps = (elapsed / statistics["time_step"][1:]).sum() / elapsed.sum() * turnover if len(elapsed) else None
        return [Metric("dns_seconds_per_step", "DNS: seconds of a step (median, without storing)", seconds),
                Metric(SIMULATION, "DNS: wall seconds per turnover (median step, mean number of steps)",
                       None if steps is None else float(steps) * seconds, "the simulation took no step")]
    if kind != "rollout":
        return []
    attributes = read_attributes(file, "rollout")
    untimed = "too few steps to time: the first two, and the first two after a restart, are left out"
    found = [Metric(key, label, attributes.get(key), untimed) for key, label in ROLLOUT_COST.items()]
    if "evaluations" in attributes and attributes["turnovers"] > 0:
        found += [Metric("storing_share", "rollout: share of the wall time that storing took",
                         attributes.get("storing_share"), "made by an earlier version"),
                  Metric("evaluations_per_turnover", "evaluations of the forces per turnover",
                         attributes["evaluations"] / attributes["turnovers"])]
    return found


def _cost_section(page: Page) -> Section:
    metrics = [*page.cost, Metric("stage_seconds", "wall seconds by stage", page.seconds or None,
                                  "no stage_seconds.json: the stages were not run by `eddies`")]
    if "rollout" not in page.provenance:
        metrics += [Metric(key, label, None, "there is no rollout.h5") for key, label in ROLLOUT_COST.items()]
    return Section("cost", "Cost", "Wall seconds of stages and of steps.", metrics=metrics,
                   main=("seconds_per_step",))


def _compare(scene: Scene | None, report: Report, page: Page, found: Mapping[str, Sequence[Row]], ranks: int,
             alone: Comm) -> tuple[list[Section], dict[str, str]]:
    """Return the section on all variants, in a list, and the texts of variants.csv and variants.json, by file name.
    Warnings about the rollouts of the other pages are added to those of the main page.

    Both results are empty if no variant was run. page: the main page. found: `numbers` of each variant's rollouts.
    ranks: the number of ranks of the job.
    """
    if not report.main:
        return [], {}
    variants = scene.variant or {scene.name: scene}
    for where in [each for runs in report.runs.values() for each in runs if each != page.directory]:
        beside = {kind: origin for kind in MAKER_OF if (origin := product_provenance(where / f"{kind}.h5"))}
        page.warnings += [f"{where.relative_to(report.directory)}: {sentence}"
                          for sentence in doubts(where, beside, report.old) if sentence.startswith(ROLLOUT)]
    rows, another = rows_of(scene, report.runs, found, alone, report.old)
    repeating = [name for name, each in variants.items() if each.coarse_cells == each.flow.cells]
    simulation = simulation_seconds(rows, repeating, page.simulation_seconds)
    add_break_even(rows, simulation)
    table = table_of_variants.ErrorAgainstTime(rows, report.main)
    remarks = notes(scene.realisations or (), another, {name: each.tracers for name, each in variants.items()},
                    {name: each.coarse_cells for name, each in variants.items()})
    lines = io.StringIO(newline="")
    writer = csv.DictWriter(lines, COLUMNS)
    writer.writeheader()
    writer.writerows(rows)
    reference = product_attributes(page.directory / "ground_truth.h5", "reference")
    flow = {key: finite(float(value)) for key, value in reference.items() if isinstance(value, (float, np.number))}
    record = {"name": scene.name, "title": scene.title, "machine": machine(scene.device, ranks), "flow": flow,
              "simulation_seconds": simulation, "rows": rows, "summary": table.summary}
    return [table_of_variants.section(table, remarks)], {
        "variants.csv": lines.getvalue(), "variants.json": json.dumps(record, indent=2, allow_nan=False) + "\n"}


def _write_main(report: Report, page: Page, first: Sequence[Section], beside: Mapping[str, str], text: str) -> None:
    """Write the main page, which begins with the sections `first`, and log its numbers; one rank calls it. `beside` and
    `text` are arguments of `_write`."""
    _draw(first)
    page.sections = [*first, *page.sections]
    page.seconds = {**read_stage_seconds(report.directory), **page.seconds}
    _write(report, page, report.directory, beside, text)
    for section in page.sections:
        count = len(section.illustrations)
        log.info("report: %s%s", section.title, f" ({count} figure{'s' if count > 1 else ''})" if count else "")
        if section.key == table_of_variants.KEY:
            log.info("  %s", section.text)
        for metric in section.metrics:
            if metric.key in section.main:
                log.info("  %-60s %s", metric.label, "-" if metric.value is None else shown(metric.value))
    for warning in page.warnings:
        log.warning("report: %s", warning)


def _write(report: Report, page: Page, directory: Path, beside: Mapping[str, str] | None = None,
           text: str = "") -> None:
    """Write the page of a run directory, a file with its numbers, and further files.

    `beside` holds the texts of the further files by file name. `text` is the scene that the page shows, as TOML. If it
    is empty, the page shows the scene of the last product.
    """
    rows = [("stage", "ranks", "wall time (s)", "date", "eddies", "commit", "libraries")]
    for kind, origin in page.provenance.items():
        stage = MAKER_OF[kind].name
        rows.append((stage, str(origin["ranks"]),
                     shown(page.seconds[stage]) if stage in page.seconds else "not stored", origin["date"],
                     origin["eddies"], origin["commit"][:12] if origin["commit"] else "not a checkout",
                     ", ".join(f"{name} {version}" for name, version in origin["libraries"].items())))
    text = text or list(page.provenance.values())[-1]["scene"]
    title = tomllib.loads(text).get("title", "untitled scene")
    record = RunRecord(directory.resolve().name, title, text, rows, page.warnings, report.links(directory))
    write_page(report.report_of(directory), record, page.sections, beside or {})
