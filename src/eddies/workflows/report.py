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

from eddies.analysis.spectra import vorticity
from eddies.analysis.tracer_statistics import tracer_statistics
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, in_files, open_product, read_attributes, read_table
from eddies.io.provenance import (others_trained_on, product_attributes, product_provenance, read_json,
                                  read_provenance)
from eddies.io.trajectories import Trajectory
from eddies.measures import finite
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import MAKER_OF
from eddies.report import figures, ground_truth, kernel, models, reconstruction, rollouts, stationary, steps, tracers
from eddies.report import summary as summary_of_variants
from eddies.report.page import Metric, RunRecord, Section, shown, strict, write_page
from eddies.report.rollout_figures import Drawn
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.scene.terms import PRESETS
from eddies.workflows.ground_truth.stationary import read_stationary_span
from eddies.workflows.problems import directory_problems
from eddies.workflows.product_warnings import doubts, not_finite, old_products
from eddies.workflows.run_directory.work import read_stage_seconds
from eddies.workflows.variant_rows import (COLUMNS, ROLLOUT, add_break_even, machine, notes, numbers, rows_of,
                                           simulation_seconds)
from eddies.workflows.variants import rollouts as rollouts_of

log = logging.getLogger("eddies")

MOST_SHOWN = 6  # largest number of variants in the figures
SIMULATION = "dns_seconds_per_turnover"
SOURCE_OF_TRACKS = ("{in_file} measured tracks from {file}, on average {mean_count:.0f} in a frame; {complete} are in "
                    "all frames. Fields are reconstructed from them by least squares. The dissipation rate is the "
                    "value of the literature for this velocity and integral scale.")
SHARED = "ground_truth", "kernel", "reconstruction"  # kinds of products that have a section for the whole run


@dataclass(frozen=True)
class Run:
    """A run directory, and the variants in it.

    scene: None if it cannot be read. variants: directories of the rollouts of each variant, by name. A run without
    variants counts as one variant. chosen: names of the variants to show. old: products that were made with other
    settings than those of the last job, as `old_products`.
    """

    directory: Path
    scene: Scene | None
    variants: Mapping[str, Sequence[Path]]
    chosen: Sequence[str] = ()
    old: Mapping[Path, Sequence[str]] = field(default_factory=dict)

    @classmethod
    def read(cls, directory: Path, chosen: Sequence[str] = ()) -> Run:
        """Read a run directory. Raises SceneError if `chosen` names an unknown variant."""
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
    def measured(self) -> list[Path]:
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

    def looks(self) -> dict[str, figures.Look]:
        """Return the colour and the marker of each variant."""
        known = {name: (self.scene.variant.get(name, self.scene) if self.scene else None) for name in self.variants}
        cells = {name: each.eulerian.cells for name, each in known.items()
                 if each is not None and each.simulation is not None and each.simulation.on_grid}
        return figures.looks({name: [name, *_presets(each)] for name, each in known.items()}, cells)


def _presets(scene: Scene | None) -> Iterator[str]:
    """Yield the presets whose terms move the particles of a scene, or its method if no model does."""
    if scene is not None and scene.simulation is not None and not scene.needs_model:
        yield scene.simulation.method
    elif scene is not None and scene.model is not None:
        yield from (name for name, terms in PRESETS.items() if set(terms) == set(scene.model.terms))


@dataclass
class Report:
    """The content of a report.

    provenance: of the products in the base directory, by kind. numbers: what metrics.json holds besides the rows.
    """

    sections: list[Section] = field(default_factory=list)
    provenance: dict[str, dict[str, Any]] = field(default_factory=dict)
    numbers: dict[str, Any] = field(default_factory=dict)
    rows: list[dict[str, Any]] = field(default_factory=list)
    warnings: list[str] = field(default_factory=list)

    def add(self, section: Section) -> None:
        """Append a section on a product of the whole run, folded, with its numbers."""
        section.folded = True
        self.sections.append(section)
        self.numbers[section.key] = section.numbers


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
    found = in_files(comm, directory, lambda: Run.read(directory, variants))
    for where in found.measured:
        _measure().update(where, comm)
        stop.check()
    stop.check()
    alone, output = comm.Split(comm.rank), output or directory / "report"
    try:
        in_files(comm, output, lambda: _write(found, make(found, comm.size, alone), output))
    finally:
        alone.Free()


def sections_of(directory: Path, alone: Comm) -> list[Section]:
    """Return the sections of the report of a run directory on one rank, with figures that are not yet made."""
    found = Run.read(directory)
    for where in found.measured:
        _measure().update(where, alone)
    return make(found, 1, alone).sections


def _measure() -> Any:
    from eddies.workflows import measure  # needs torch, which other runs do not
    return measure


def make(run: Run, ranks: int, alone: Comm) -> Report:
    """Read the products and the measures of a run, and return the content of its report. `ranks` is the number of ranks
    of the job."""
    report, scanned, looks = Report(), {}, run.looks()
    labels = {name: (run.scene.variant.get(name, run.scene).label if run.scene else None) or name
              for name in run.variants}
    measures = {where: _measure().read(where, alone) for where in run.measured}
    found = {name: (runs[0], *measures[runs[0]]) for name, runs in run.variants.items() if runs[0] in measures}
    drawn = {name: Drawn(labels[name], looks[name], *found[name][1:]) for name in run.shown}
    shared: list[Section] = []
    cost = _read_shared(run, alone, report, shared, scanned)
    if run.scene is not None and found:
        report.sections.append(_compare(run, report, measures, looks, cost, ranks, alone))
    if drawn:
        costs = {name: rollouts.rollout_numbers(numbers, read_stage_seconds(where))
                 for name, (where, numbers, _) in found.items()}
        report.sections.append(rollouts.section(drawn, costs, len(found) - len(drawn)))
        report.numbers["rollouts"] = costs
        if forced := {name: each for name, each in drawn.items() if "forced" in each.numbers}:
            report.sections.append(rollouts.forced_section(forced))
        report.numbers["forced"] = {name: numbers["forced"] for name, (_, numbers, _) in found.items()
                                    if "forced" in numbers}
    _add_learned(run, alone, report, labels, looks, scanned)
    for section in shared:
        report.add(section)
    if not report.provenance:
        raise ProductError(f"{run.directory}: holds none of {', '.join(f'{kind}.h5' for kind in MAKER_OF)}; "
                           "run `eddies dns SCENE` first")
    report.warnings = [*doubts(run.base, report.provenance, run.old), *_other_doubts(run),
                       *(words for words in scanned.values() if words)]
    return report


def _read_shared(run: Run, alone: Comm, report: Report, sections: list[Section], scanned: dict[Path, str]
                 ) -> list[Metric]:
    """Read the products in the base directory: their provenance and, of those in SHARED, sections. Return the metrics
    of the cost of the direct simulation. Results of `not_finite` are added to `scanned`, by file."""
    cost: list[Metric] = []
    readers = {
        "ground_truth": _ground_truth_sections,
        "kernel": lambda file: [kernel.section(read_json(file, "description")["support"], **{
            name: read_table(file, name) for name in ("kernels", "slices", "errors")})],
        "reconstruction": lambda file: [reconstruction.section(
            read_attributes(file, "about"), read_table(file, "errors_over_time"),
            read_table(file, "errors_of_fields") if "errors_of_fields" in file else {}, _middle_plane(file))]}
    for kind in MAKER_OF:
        path = run.base / f"{kind}.h5"
        if not path.exists():
            continue
        with open_product(alone, path, kind) as file:
            report.provenance[kind] = read_provenance(file)
            scanned[path.resolve()] = not_finite(file, kind)
            if kind == "ground_truth" and "tracks" not in file:
                cost = _simulation_cost(file)
            if kind in SHARED:
                sections[:0] = readers[kind](file)
    seconds = {**read_stage_seconds(run.directory), **read_stage_seconds(run.base)}
    sections.insert(0, Section("cost", "Cost", "Wall seconds of stages and of steps.", metrics=[*cost, Metric(
        "stage_seconds", "wall seconds by stage", seconds or None,
        "no stage_seconds.json: the stages were not run by `eddies`")]))
    return cost


def _add_learned(run: Run, alone: Comm, report: Report, labels: Mapping[str, str], looks: Mapping[str, figures.Look],
                 scanned: dict[Path, str]) -> None:
    """Add sections on the models and the steps of the variants."""
    trained: dict[str, models.TrainedModel] = {}
    searches: dict[str, steps.Search] = {}
    for name, (where, *_) in run.variants.items():
        for kind in ("model", "step", "rollout"):
            path = where / f"{kind}.h5"
            if not path.exists():
                continue
            with open_product(alone, path, kind) as file:
                if path.resolve() not in scanned:
                    scanned[path.resolve()] = not_finite(file, kind)
                if kind == "model":
                    trained[name] = _model(file, labels[name], looks[name])
                elif kind == "step":
                    searches[name] = steps.Search(labels[name], looks[name], read_attributes(file, "found"), {
                        method: read_table(file, f"trials/{method}") for method in file["trials"]})
    if trained:
        report.numbers["models"] = {name: _values(each.metrics) for name, each in trained.items()}
        report.sections.append(models.section(_first(trained, run)))
    if searches:
        report.numbers["steps"] = {name: _values([*each.chosen, *each.tried]) for name, each in searches.items()}
        report.sections.append(steps.section(_first(searches, run)))


def _first(found: Mapping[str, Any], run: Run) -> dict[str, Any]:
    """Return the entries of the variants that are shown or, if there are none, the first entries."""
    return {name: found[name] for name in ([name for name in run.shown if name in found] or [*found][:MOST_SHOWN])}


def _values(metrics: Sequence[Metric]) -> dict[str, Any]:
    return {metric.key: metric.value for metric in metrics}


def _model(file: File, label: str, look: figures.Look) -> models.TrainedModel:
    """Read model.h5. A model with the weights of another run shares their history."""
    provenance = read_provenance(file)
    tables = {name: read_table(file, name) for name in (
        "a_priori", "acceleration_sample", "density_rate_sample", "history", "source_a_priori") if name in file}
    source, others = provenance.get("source"), others_trained_on(provenance)
    if source and "truths" in source:
        others = [path if reached is None else f"{path} (M_t = {reached:.3f})"
                  for path, reached in source["truths"].items()]
    return models.TrainedModel(label, look, read_json(file, "description"), tables, source, others,
                               provenance.get("mach_turbulent"))


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


def _simulation_cost(file: File) -> list[Metric]:
    """Return metrics of the cost of the steps of the direct simulation in an open ground_truth.h5."""
    statistics, turnover = read_table(file, "statistics"), file["reference"].attrs["eddy_turnover_time"]
    seconds = float(np.median(statistics["seconds_per_step"]))
    elapsed = np.diff(statistics["time"])
    steps = (elapsed / statistics["time_step"][1:]).sum() / elapsed.sum() * turnover if len(elapsed) else None
    return [Metric("dns_seconds_per_step", "DNS: seconds of a step (median, without storing)", seconds),
            Metric(SIMULATION, "DNS: wall seconds per turnover (median step, mean number of steps)",
                   None if steps is None else float(steps) * seconds, "the simulation took no step")]


def _other_doubts(run: Run) -> Iterator[str]:
    """Yield warnings about the rollouts in other directories than the base directory."""
    for where in [each for runs in run.variants.values() for each in runs if each != run.base]:
        beside = {kind: origin for kind in MAKER_OF if (origin := product_provenance(where / f"{kind}.h5"))}
        yield from (f"{where.relative_to(run.directory)}: {sentence}" for sentence in doubts(where, beside, run.old)
                    if sentence.startswith(ROLLOUT))


def _compare(run: Run, report: Report, measures: Mapping[Path, Sequence[Any]], looks: Mapping[str, figures.Look],
             cost: Sequence[Metric], ranks: int, alone: Comm) -> Section:
    """Return the section on all variants, and add rows, summary and what belongs to them to the numbers of the report.

    measures: numbers and tables of each rollout, by its directory. cost: metrics of the direct simulation.
    """
    scene = run.scene
    variants = scene.variant or {scene.name: scene}
    found = {name: [numbers(measures[where][0]) for where in runs] for name, runs in run.variants.items()
             if all(where in measures for where in runs)}
    rows, another = rows_of(scene, run.variants, found, alone, run.old)
    repeating = [name for name, each in variants.items() if each.coarse_cells == each.flow.cells]
    of_truth = next((metric.value for metric in cost if metric.key == SIMULATION), None)
    simulation = simulation_seconds(rows, repeating, of_truth)
    add_break_even(rows, simulation)
    table = summary_of_variants.ErrorAgainstTime(rows, run.shown[0], looks)
    remarks = notes(scene.realisations or (), another, {name: each.tracers for name, each in variants.items()},
                    {name: each.coarse_cells for name, each in variants.items()})
    reference = product_attributes(run.base / "ground_truth.h5", "reference")
    flow = {key: finite(float(value)) for key, value in reference.items() if isinstance(value, (float, np.number))}
    report.rows = rows
    report.numbers |= {"name": scene.name, "title": scene.title, "machine": machine(scene.device, ranks), "flow": flow,
                       "simulation_seconds": simulation, "rows": rows, "summary": table.summary}
    return summary_of_variants.section(table, remarks)


def _draw(sections: Sequence[Section]) -> None:
    """Draw the figures of sections. A figure that fails is left out with a warning."""
    for illustration in (each for section in sections for each in section.illustrations):
        try:
            illustration.png = figures.png(illustration.make())
        except Exception as error:  # an error of matplotlib or its settings must not lose the rest of the report
            log.warning("report: a figure is left out, because drawing %s fails (%s: %s)", illustration.name,
                        type(error).__name__, error)


def _write(run: Run, report: Report, output: Path) -> None:
    """Draw the figures, write the page and the numbers, and log the main numbers; one rank calls it."""
    _draw(report.sections)
    rows = [("stage", "ranks", "wall time (s)", "date", "eddies", "commit", "libraries")]
    seconds = {**read_stage_seconds(run.directory), **read_stage_seconds(run.base)}
    for kind, origin in report.provenance.items():
        stage = MAKER_OF[kind].name
        rows.append((stage, str(origin["ranks"]), shown(seconds[stage]) if stage in seconds else "not stored",
                     origin["date"], origin["eddies"],
                     origin["commit"][:12] if origin["commit"] else "not a checkout",
                     ", ".join(f"{name} {version}" for name, version in origin["libraries"].items())))
    text = run.scene.to_toml() if run.scene is not None and run.scene.variant else (
        list(report.provenance.values())[-1]["scene"])
    title = tomllib.loads(text).get("title", "untitled scene")
    record = RunRecord(run.directory.resolve().name, title, text, rows, report.warnings)
    texts = {"metrics.json": json.dumps(strict({"warnings": report.warnings, **report.numbers}), indent=2,
                                        allow_nan=False) + "\n"}
    if report.rows:
        lines = io.StringIO(newline="")
        writer = csv.DictWriter(lines, COLUMNS)
        writer.writeheader()
        writer.writerows(report.rows)
        texts["variants.csv"] = lines.getvalue()
    write_page(output, record, report.sections, texts)
    for section in report.sections:
        count = len(section.illustrations)
        log.info("report: %s%s", section.title, f" ({count} figure{'s' if count > 1 else ''})" if count else "")
        if section.key == "summary":
            log.info("  %s", section.text)
            for metric in section.metrics:
                log.info("  %s: %s", metric.label, shown(metric.value))
    for warning in report.warnings:
        log.warning("report: %s", warning)
