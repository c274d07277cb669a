"""The report of a run: a page with figures, and a file with the numbers as JSON.

Rank 0 makes both from the products of the run and from the measures of its rollouts. Every product is optional: the
page has sections for the products that exist. Rollouts without current measures are measured first, by all ranks.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import logging
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from eddies.analysis.tracer_statistics import tracer_statistics
from eddies.analysis.velocity_gradients import vorticity
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, in_files, open_product, read_attributes, read_table
from eddies.io.provenance import (others_trained_on, product_attributes, product_provenance, read_json,
                                  read_provenance)
from eddies.io.trajectories import Trajectory
from eddies.measures import finite
from eddies.parallel.communicator import Comm
from eddies.parallel.step_times import quartiles, was_busy
from eddies.parallel.stop import StopRequest
from eddies.pipeline import FILE_OF, MAKER_OF
from eddies.report import (figures, ground_truth, kernel, models, reconstruction, rollouts, stationary, steps, summary,
                           tracers)
from eddies.report.figures import Variant
from eddies.report.page import Section, strict, write_page
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.scene.terms import PRESETS
from eddies.workflows.ground_truth.stationary import read_stationary_span
from eddies.workflows.problems import directory_problems
from eddies.workflows.product_warnings import doubts, not_finite, old_products
from eddies.workflows.run_directory.work import read_stage_seconds
from eddies.workflows.variant_rows import (COLUMNS, ROLLOUT, machine, notes, numbers, rows_of,
                                           simulation_seconds)
from eddies.workflows.variants import rollouts as rollouts_of

log = logging.getLogger("eddies")

MOST_SHOWN = 6  # largest number of variants in the figures
SIMULATION = "dns_seconds_per_turnover"
COSTS = {"dns_seconds_per_step": "DNS: seconds of a step (median, without storing)",
         SIMULATION: "DNS: wall seconds per turnover (median step, mean number of steps)",
         "busy": "the machine was busy", "stage_seconds": "wall seconds by stage"}
NOT_COMPARABLE = "times are not comparable: the machine was busy"
REASONS = {SIMULATION: "the simulation took no step",
           "stage_seconds": "no stage_seconds.json: the stages were not run by `eddies`"}
SOURCE_OF_TRACKS = ("{in_file} measured tracks from {file}, on average {mean_count:.0f} in a frame; {complete} are in "
                    "all frames. Fields are reconstructed from them by least squares. The dissipation rate is the "
                    "value of the literature for this velocity and integral scale.")


@dataclass
class Report:
    """A run directory, and the report that is made of it.

    Parameters
    ----------
    scene : None if it cannot be read.
    variants : directories of the rollouts of each variant, by name. A run without variants counts as one variant.
    chosen : names of the variants to show.
    old : products that were made with other settings than those of the last job, as `old_products`.
    sections : the content of the page.
    provenance : that of the products in the directory `base`, by kind.
    numbers : the content of metrics.json without warnings.
    scanned : a sentence on each product with numbers that are not finite, else "", by file.
    kept : measures that could not be written beside their rollout, by its directory.
    """

    directory: Path
    scene: Scene | None
    variants: Mapping[str, Sequence[Path]]
    chosen: Sequence[str] = ()
    old: Mapping[Path, Sequence[str]] = field(default_factory=dict)
    sections: list[Section] = field(default_factory=list)
    provenance: dict[str, dict[str, Any]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    scanned: dict[Path, str] = field(default_factory=dict)
    kept: dict[Path, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, directory: Path, chosen: Sequence[str] = ()) -> Report:
        """Return a report without content. Raises SceneError if `chosen` names an unknown variant."""
        scene, runs, old = None, {}, {}
        with contextlib.suppress(SceneError):
            scene = load_scene(directory / "scene.toml")
        if scene is not None:
            scene.check_variants(chosen)
            old = old_products(scene, directory)
            if scene.simulation is not None:
                runs = {name: [*found] for name, found in rollouts_of(scene, directory).items()}
        name = scene.name if scene is not None else directory.resolve().name
        return cls(directory, scene, runs or {name: [directory]}, chosen, old)

    @property
    def rollouts(self) -> list[Path]:
        """The directories of all rollouts that exist."""
        return [where for runs in self.variants.values() for where in runs if (where / ROLLOUT).exists()]

    @cached_property
    def ran(self) -> list[str]:
        """Names of the variants with a rollout. Those to show come first, then those that were made with the settings
        of the scene."""
        found = {name: runs[0] / ROLLOUT for name, runs in self.variants.items() if (runs[0] / ROLLOUT).exists()}
        return sorted(found, key=lambda name: (name not in self.chosen, bool(self.old.get(found[name]))))

    @property
    def shown(self) -> list[str]:
        """Names of the variants in the figures: those in `chosen` that were run, or else the first ones."""
        return ([name for name in self.chosen if name in self.ran] or self.ran)[:MOST_SHOWN]

    @property
    def base(self) -> Path:
        """The directory whose products the page describes: that of the first variant shown."""
        return self.variants[self.shown[0]][0] if self.shown else self.directory

    @property
    def asked_for(self) -> bool:
        """Whether the scene asks for the rollouts. If not, they are those of an earlier scene."""
        return self.scene is not None and self.scene.simulation is not None and bool(
            self.scene.variant or not self.scene.sets)

    def scene_of(self, name: str) -> Scene | None:
        """Return the scene of a variant."""
        return self.scene and self.scene.variant.get(name, self.scene)

    @cached_property
    def looks(self) -> dict[str, figures.Look]:
        """The colour and the marker of each variant."""
        known = {name: self.scene_of(name) for name in self.variants}
        cells = {name: each.coarse_cells for name, each in known.items() if each is not None and each.coarse_cells}
        return figures.looks({name: [name, *_presets(each)] for name, each in known.items()}, cells)

    def variant(self, name: str, numbers: Mapping[str, Any], tables: Mapping[str, figures.Table]) -> Variant:
        """Return a variant for figures."""
        scene = self.scene_of(name)
        return Variant(scene and scene.label or name, self.looks[name], numbers, tables)

    def first(self, found: Mapping[str, Any]) -> list[Any]:
        """Return the values of the variants that are shown or, if there are none, the first values."""
        return [found[name] for name in self.shown if name in found] or [*found.values()][:MOST_SHOWN]

    @contextlib.contextmanager
    def opened(self, directory: Path, kind: str, alone: Comm) -> Iterator[File | None]:
        """Open a product and scan it; None if there is none."""
        path = directory / FILE_OF[kind]
        if not path.exists():
            yield None
            return
        with open_product(alone, path, kind) as file:
            if path.resolve() not in self.scanned:
                self.scanned[path.resolve()] = not_finite(file, kind)
            yield file


def _presets(scene: Scene | None) -> Iterator[str]:
    """Yield the presets whose terms move the particles of a scene, or its method if no model does."""
    if scene is not None and scene.simulation is not None and not scene.needs_model:
        yield scene.simulation.method
    elif scene is not None and scene.model is not None:
        yield from (name for name, terms in PRESETS.items() if set(terms) == set(scene.model.terms))


def run(directory: str | Path, comm: Comm, variants: Sequence[str] = (), stop: StopRequest | None = None,
        output: Path | None = None) -> None:
    """Write report/index.html, report/figures/*.png, report/metrics.json and report/variants.csv of a run directory;
    all ranks call it. If `output` is given, the files are written there.

    The figures show the variants `variants`, as far as they were run, or else the first variants of the scene.

    Raises ProductError if the directory holds no product or a damaged one, or if the report cannot be written. Raises
    SceneError if `variants` names an unknown variant, and Stopped, before anything is written, if `stop` requests it.
    """
    directory, stop = Path(directory), stop or StopRequest(comm)
    for problem in directory_problems(("report",), comm, directory) if output is None else ():
        raise SceneError(problem)
    report = in_files(comm, directory, lambda: Report.of(directory, variants))
    for where in in_files(comm, directory, lambda: report.rollouts):
        _measure().update(where, comm, None if output is None else report.kept)
        stop.check()
    stop.check()
    alone, output = comm.Split(comm.rank), output or directory / "report"
    try:
        in_files(comm, output, lambda: [_make(report, comm.size, alone), _write(report, output)])
    finally:
        alone.Free()


def sections_of(directory: Path, alone: Comm) -> list[Section]:
    """Return the sections of the report of a run directory on one rank, with figures that are not yet made."""
    report = Report.of(directory)
    for where in report.rollouts:
        _measure().update(where, alone, report.kept)
    _make(report, 1, alone)
    return report.sections


def _measure() -> Any:
    from eddies.workflows import measure  # needs torch, which other runs do not
    return measure


def _make(report: Report, ranks: int, alone: Comm) -> None:
    """Read the products and the measures of a run, and add the content of its report. `ranks` is the number of ranks of
    the job."""
    measures = {where: report.kept.get(where) or _measure().read(where, alone) for where in report.rollouts}
    found = {name: report.variant(name, *measures[runs[0]]) for name, runs in report.variants.items()
             if runs[0] in measures}
    shared = _shared(report, alone)
    if not report.provenance:
        raise ProductError(f"{report.directory}: holds none of {', '.join(stage.file for stage in MAKER_OF.values())}; "
                           "run `eddies dns SCENE` first")
    if report.asked_for and found:
        report.sections.append(_compare(report, measures, shared[0].numbers.get(SIMULATION), ranks, alone))
    if found:
        drawn = report.first(found)
        numbers = {name: rollouts.rollout_numbers(each.numbers, read_stage_seconds(report.variants[name][0]))
                   for name, each in found.items()}
        report.numbers["rollouts"] = numbers
        report.numbers["forced"] = {name: each.numbers["forced"] for name, each in found.items()
                                    if "forced" in each.numbers}
        report.sections.append(rollouts.section(drawn, report.first(numbers), len(found) - len(drawn)))
        if forced := [each for each in drawn if "forced" in each.numbers]:
            report.sections.append(rollouts.forced_section(forced))
    _add_learned(report, alone)
    report.sections += shared
    report.numbers |= {section.key: section.numbers for section in shared}
    seconds = report.numbers["cost"]["stage_seconds"] or {}
    stages = {MAKER_OF[kind].name: {"wall seconds": seconds.get(MAKER_OF[kind].name), **origin}
              for kind, origin in report.provenance.items()}
    report.sections.append(Section("run", "The run", columns={
        key: {stage: origin[key] for stage, origin in stages.items()}
        for key in ("wall seconds", "ranks", "date", "eddies", "commit", "libraries")}))
    report.numbers["warnings"] = [*doubts(report.base, report.provenance, report.old), *_other_doubts(report),
                                  *_busy_times(report.numbers),
                                  *(words for words in report.scanned.values() if words)]


def _shared(report: Report, alone: Comm) -> list[Section]:
    """Read the products in the base directory and add their provenance. Return the sections on costs and on products of
    the whole run."""
    cost: dict[str, Any] = {}
    sections: list[Section] = []
    readers = {
        "ground_truth": _ground_truth_sections,
        "kernel": lambda file: [kernel.section(read_json(file, "description")["support"], **{
            name: read_table(file, name) for name in ("kernels", "slices", "errors")})],
        "reconstruction": lambda file: [reconstruction.section(
            read_attributes(file, "about"), read_table(file, "errors_over_time"),
            read_table(file, "errors_of_fields") if "errors_of_fields" in file else {}, _middle_planes(file),
            read_attributes(file, "left_out") if "left_out" in file else {})]}
    for kind in MAKER_OF:
        with report.opened(report.base, kind, alone) as file:
            if file is not None:
                report.provenance[kind] = read_provenance(file)
                if kind == "ground_truth" and "tracks" not in file:
                    cost = _simulation_cost(file)
                if kind in readers:
                    sections[:0] = readers[kind](file)
    seconds = {**read_stage_seconds(report.directory), **read_stage_seconds(report.base)}
    return [Section("cost", "Cost", "Wall seconds of stages and of steps.", {**cost, "stage_seconds": seconds or None},
                    COSTS, REASONS), *sections]


def _add_learned(report: Report, alone: Comm) -> None:
    """Add sections on the models and the steps of the variants."""
    trained: dict[str, Variant] = {}
    searches: dict[str, Variant] = {}
    realised = report.scene is not None and report.scene.realisations is not None
    for name, (where, *_) in report.variants.items():
        with report.opened(where, "model", alone) as file:
            if file is not None:
                trained[name] = report.variant(name, *_model(file))
        with report.opened(where.parent if realised else where, "step", alone) as file:
            if file is not None:
                searches[name] = report.variant(name, read_attributes(file, "found"), {
                    method: read_table(file, f"trials/{method}") for method in file["trials"]})
        with report.opened(where, "rollout", alone):
            pass
    for key, part, all_of_it in (("models", models, trained), ("steps", steps, searches)):
        if all_of_it:
            report.numbers[key] = {name: part.numbers_of(each) for name, each in all_of_it.items()}
            report.sections.append(part.section(report.first(all_of_it)))


def _model(file: File) -> tuple[dict[str, Any], dict[str, figures.Table]]:
    """Return what the report shows of model.h5, as `models.section` needs it."""
    provenance = read_provenance(file)
    source, others = provenance.get("source"), others_trained_on(provenance)
    if source and "truths" in source:
        others = [path if reached is None else f"{path} (M_t = {reached:.3f})"
                  for path, reached in source["truths"].items()]
    return {**read_json(file, "description"), "provenance": provenance, "others": others}, {
        name: read_table(file, name) for name in (
            "a_priori", "acceleration_sample", "density_rate_sample", "history", "source_a_priori") if name in file}


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


def _middle_planes(file: File) -> dict[str, np.ndarray]:
    """Return u_x and its standard deviation in the plane z = pi of the last reconstruction, by label, if stored."""
    series = FieldSeries(file, "reconstructed")
    middle = series.cells // 2
    return {label: series.read(-1, name, middle, middle + 1)[0, 0]
            for name, label in (("velocity", "u_x"), ("velocity_deviation", "standard deviation of u_x"))
            if name in series.variables}


def _simulation_cost(file: File) -> dict[str, Any]:
    """Return the cost of the steps of the direct simulation in an open ground_truth.h5."""
    statistics, turnover = read_table(file, "statistics"), file["reference"].attrs["eddy_turnover_time"]
    samples = statistics["seconds_per_step"]
    timed = quartiles(samples[1:] if len(samples) > 1 else samples)  # the first belongs to the start, to no step
    if "surplus_load" in statistics:
        timed["surplus_load"] = float(np.median(statistics["surplus_load"]))
    seconds = float(timed["seconds_per_step"])
    elapsed = np.diff(statistics["time"])
    steps = (elapsed / statistics["time_step"][1:]).sum() / elapsed.sum() * turnover if len(elapsed) else None
    return {"dns_seconds_per_step": seconds, SIMULATION: None if steps is None else float(steps) * seconds,
            "busy": was_busy(timed)}


def _other_doubts(report: Report) -> Iterator[str]:
    """Yield warnings about the rollouts in other directories than the base directory."""
    for where in [each for runs in report.variants.values() for each in runs if each != report.base]:
        beside = {kind: origin for kind in MAKER_OF if (origin := product_provenance(where / FILE_OF[kind]))}
        yield from (f"{where.relative_to(report.directory)}: {sentence}"
                    for sentence in doubts(where, beside, report.old) if sentence.startswith(ROLLOUT))


def _busy_times(numbers: Mapping[str, Any]) -> Iterator[str]:
    """Yield a sentence on each kind of time in metrics.json that was measured on a busy machine."""
    for kind, busy in (("rollouts of ", [row["label"] for row in numbers.get("rows", ()) if row["busy"]]),
                       ("searches for the step of ", [name for name, each in numbers.get("steps", {}).items()
                                                      if each["busy"]]),
                       ("", ["direct simulation"] if numbers["cost"].get("busy") else [])):
        if busy:
            yield f"{kind}{', '.join(busy)}: {NOT_COMPARABLE}"


def _compare(report: Report, measures: Mapping[Path, Sequence[Any]], of_truth: float | None, ranks: int,
             alone: Comm) -> Section:
    """Return the section on all variants, and add rows, summary and what belongs to them to the numbers of the report.

    measures: numbers and tables of each rollout, by its directory. of_truth: seconds of a turnover of the ground truth.
    """
    scene = report.scene
    variants = scene.variant or {scene.name: scene}
    found = {name: [numbers(measures[where][0]) for where in runs] for name, runs in report.variants.items()
             if all(where in measures for where in runs)}
    rows, another = rows_of(scene, report.variants, found, alone, report.old)
    repeating = [name for name, each in variants.items() if each.coarse_cells == each.flow.cells]
    simulation = simulation_seconds(rows, repeating, of_truth)
    table = summary.ErrorAgainstTime(rows, report.shown[0], report.looks)
    reference = product_attributes(report.base / FILE_OF["ground_truth"], "reference")
    flow = {key: finite(float(value)) for key, value in reference.items() if isinstance(value, (float, np.number))}
    report.numbers |= {"name": scene.name, "title": scene.title, "machine": machine(scene.device, ranks), "flow": flow,
                       "simulation_seconds": simulation, "rows": rows, "summary": table.summary}
    return summary.section(table, notes(scene.realisations or (), another, variants))


def _draw(sections: Sequence[Section]) -> None:
    """Draw the figures of sections. A figure that fails is left out with a warning."""
    for illustration in (each for section in sections for each in section.illustrations):
        try:
            illustration.png = figures.png(illustration.make())
        except Exception as error:  # an error of matplotlib or its settings must not lose the rest of the report
            log.warning("report: a figure is left out, because drawing %s fails (%s: %s)", illustration.name,
                        type(error).__name__, error)


def _write(report: Report, output: Path) -> None:
    """Draw the figures, write the page and the numbers, and log the main numbers; one rank calls it."""
    _draw(report.sections)
    warnings = report.numbers["warnings"]
    text = report.scene.to_toml() if report.scene is not None and report.scene.variant else (
        list(report.provenance.values())[-1]["scene"])
    texts = {"metrics.json": json.dumps(strict(report.numbers), indent=2, allow_nan=False) + "\n"}
    if "rows" in report.numbers:
        lines = io.StringIO(newline="")
        writer = csv.DictWriter(lines, COLUMNS)
        writer.writeheader()
        writer.writerows(report.numbers["rows"])
        texts["variants.csv"] = lines.getvalue()
    write_page(output, report.sections, texts, name=report.directory.resolve().name, scene=text, warnings=warnings,
               title=tomllib.loads(text).get("title", "untitled scene"))
    for section in report.sections:
        count = len(section.illustrations)
        log.info("report: %s%s", section.title, f" ({count} figure{'s' if count > 1 else ''})" if count else "")
        if section.key == "summary":
            log.info("  %s", section.text)
            (_, *titles), *rows = section.table
            for label, *cells in rows:
                log.info("  %s: %s", label, ", ".join(map(" ".join, zip(titles, cells))))
    for warning in warnings:
        log.warning("report: %s", warning)
