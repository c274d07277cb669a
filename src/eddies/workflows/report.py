"""The report of a run: the paper's figures from the run's own products, one page, and the numbers as JSON.

Every product is optional; a section appears for what there is. Each rank makes some of the sections, all draw.
"""

from __future__ import annotations

import contextlib
import csv
import io
import json
import logging
import os
import time
import tomllib
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from eddies.analysis.isotropic_turbulence import StationarySpan
from eddies.analysis.rollout import Rollout
from eddies.analysis.spectra import energy_spectrum, vorticity
from eddies.analysis.tracer_statistics import tracer_statistics
from eddies.io.fields import FieldSeries
from eddies.io.hdf5 import File, ProductError, in_files, open_product, read_attributes, read_table
from eddies.io.provenance import others_trained_on, product_attributes, read_json, read_provenance
from eddies.io.trajectories import Trajectory
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import MAKER_OF
from eddies.report import forced, ground_truth, kernel, mach, stationary, steps, tracers
from eddies.report.figures import draw
from eddies.report.model import section as model_section
from eddies.report.page import Metric, RunRecord, Section, metrics_json, shown, write_page
from eddies.report.rollout import section as rollout_section
from eddies.report.variants import KEY as VARIANTS
from eddies.report.variants import ErrorAgainstTime
from eddies.report.variants import section as section_on_variants
from eddies.report.verdict import KEY as VERDICT
from eddies.report.verdict import arranged
from eddies.scene.scene import Scene, SceneError, load_scene
from eddies.workflows.problems import place_problems
from eddies.workflows.product_warnings import changed_truths, mixed_products, not_finite
from eddies.workflows.run_directory.work import read_stage_seconds
from eddies.workflows.variant_rows import COLUMNS, ROLLOUT, finite, machine, notes, row
from eddies.workflows.variants import Place, rollouts

log = logging.getLogger("eddies")

KINDS = "ground_truth", "kernel", "model", "step", "rollout"  # products, in the order of the page
ROLLOUT_COST = {"seconds_per_step": "rollout: seconds of a step (median, without storing)",
                "particles": "particles of the rollout",
                "ranks": "ranks of the rollout"}


@dataclass
class Run:
    """What all products say in short: wall seconds by stage, all that is wrong in sentences, that on numbers that are
    not finite by product, provenance by product, cost, and what sections need of another product than their own."""

    seconds: dict[str, float]
    warnings: list[str] = field(default_factory=list)
    not_finite: dict[str, str] = field(default_factory=dict)
    provenance: dict[str, dict[str, Any]] = field(default_factory=dict)
    cost: list[Metric] = field(default_factory=list)
    eulerian: dict[str, np.ndarray] | None = None
    stationary: StationarySpan | None = None
    forced: bool = False


def run_stage(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None,
              variants: Sequence[str] = ()) -> None:
    """The report as a stage of a scene."""
    run(directory, comm, variants, stop)


def run(directory: str | Path, comm: Comm, variants: Sequence[str] = (), stop: StopRequest | None = None) -> None:
    """Write report/index.html, report/figures/*.png and report/metrics.json of a run directory; all ranks call it.

    Of a scene with variants the page begins with their table and goes on with the first of `variants` that was run or,
    without one, of all that were run; every other one has a page of its own, one click away.

    Raises ProductError if the directory holds no product, or a damaged one, or the report cannot be written; SceneError
    if a variant is named that the scene has not; Stopped, before a page is written, when `stop` asks for it.
    """
    directory, scanned, stop = Path(directory), {}, stop or StopRequest(comm)
    for problem in place_problems(("report",), comm, directory):
        raise SceneError(problem)
    scene, places = in_files(comm, directory, lambda: stored_rollouts(directory))
    if scene is not None:
        scene.check_variants(variants)
    ran = rolled_out(places)
    chosen = next((name for name in (*variants, *ran) if name in ran), None)
    main = directory if chosen is None else ran[chosen]
    pages = {name: where for name, where in ran.items() if where != directory}
    alone = comm.Split(comm.rank)
    try:
        for name, where in pages.items():
            if where != main:
                record, sections = _made(where, comm, alone, scanned, stop, own=True)
                _write_report(comm, where / "report", record, sections, _links(scene, directory, where, pages))
                log.info("report: variant %s: %s", name, where / "report" / "index.html")
        table = None if chosen is None else _table(scene, places, chosen, comm, alone)
        first = [section_on_variants(table, notes(scene))] if table else []
        record, sections = _made(main, comm, alone, scanned, stop, first=first)
    finally:
        alone.Free()
    if main != directory:  # the variant that is shown has a page of its own too
        own = [section for section in sections if section.key != VARIANTS]
        _write_report(comm, main / "report", record, own, _links(scene, directory, main, pages))
        record.seconds = {**read_stage_seconds(directory), **record.seconds}
    beside = _files_of(scene, table, directory, comm) if table else {}
    links = _links(scene, directory, directory, pages, chosen)
    _write_report(comm, directory / "report", record, sections, links, beside, scene)
    if comm.rank == 0:
        _tell(record, sections)


def stored_rollouts(directory: Path) -> tuple[Scene | None, dict[str, list[Place]]]:
    """The scene that a run directory was made with, and the rollouts of its variants by name; None and no rollouts
    where there is no scene that this version reads."""
    try:
        scene = load_scene(directory / "scene.toml")
    except SceneError:
        return None, {}
    return scene, rollouts(scene, directory) if scene.simulation is not None else {}


def rolled_out(places: Mapping[str, Sequence[Place]]) -> dict[str, Path]:
    """The directory of the first rollout of each variant that was run."""
    return {name: where[0].directory for name, where in places.items() if (where[0].directory / ROLLOUT).exists()}


def _made(directory: Path, comm: Comm, alone: Comm, scanned: dict[Path, str], stop: StopRequest, own: bool = False,
          first: Sequence[Section] = ()) -> tuple[Run, list[Section]]:
    """All sections on a run directory, with those that come `first`, their figures drawn, on rank 0; with `own` only
    those on products that were made there. Raises Stopped, before and after drawing, when `stop` asks for it."""
    began = time.perf_counter()
    record = in_files(comm, directory, lambda: _survey(directory, alone, scanned))
    kinds = [kind for kind in record.provenance if not (own and (directory / f"{kind}.h5").is_symlink())]
    found = _read_share(directory, comm, alone, record, kinds)
    if comm.rank == 0:
        found = [*first, *found]
    read = time.perf_counter()
    stop.check()
    draw(comm, found)
    stop.check()
    log.debug("report: read and measured in %.1f s, drawn in %.1f s", read - began, time.perf_counter() - read)
    gathered = comm.gather(found) or []
    sections = [section for part in gathered for section in part] + [_cost_section(record)]
    return record, arranged(sections, bool(record.warnings))


def _table(scene: Scene, places: Mapping[str, Sequence[Place]], subject: str, comm: Comm,
           alone: Comm) -> ErrorAgainstTime:
    """The rows of all variants; each rank measures some of them. The truths come first, with the help of all ranks, so
    that none is measured again for another variant."""
    from eddies.workflows.rollout.measured import open_together  # torch
    for place in places[subject]:
        if (place.directory / ROLLOUT).exists():
            with open_together(place.directory, comm, alone) as measured:
                measured.measure(comm, whole=False)
    names = list(places)
    own = on_all_ranks(comm, lambda: {name: in_files(alone, places[name][0].directory, lambda: row(
        scene, name, places[name], alone)) for name in names[comm.rank::comm.size]}, ProductError)
    rows = {name: found for part in comm.allgather(own) for name, found in part.items()}
    return ErrorAgainstTime([rows[name] for name in names], subject)


def _files_of(scene: Scene, table: ErrorAgainstTime, directory: Path, comm: Comm) -> dict[Path, str]:
    """The rows as CSV and JSON, by their paths."""
    lines = io.StringIO(newline="")
    writer = csv.DictWriter(lines, COLUMNS)
    writer.writeheader()
    writer.writerows(table.rows)
    first = next(each for each in stored_rollouts(directory)[1][table.subject])
    reference = product_attributes(first.directory / "ground_truth.h5", "reference")
    known = {key: finite(float(value)) for key, value in reference.items() if isinstance(value, (float, np.number))}
    record = {"name": scene.name, "title": scene.title, "machine": machine(scene.device, comm.size), "flow": known,
              "rows": table.rows, "summary": table.summary}
    return {directory / "report" / "variants.csv": lines.getvalue(),
            directory / "report" / "variants.json": json.dumps(record, indent=2, allow_nan=False) + "\n"}


def _links(scene: Scene | None, directory: Path, page: Path, pages: Mapping[str, Path],
           shown: str | None = None) -> list[tuple[str, str]]:
    """The other pages of a run directory, as they are reached from that in `page`."""
    found = [] if page == directory else [(f"all of {scene.name}", directory)]
    found += [(name, where) for name, where in pages.items() if where != page and name != shown]
    return [(title, os.path.relpath(where / "report" / "index.html", page / "report")) for title, where in found]


def sections_of(directory: Path, alone: Comm) -> list[Section]:
    """All sections of the page of a run directory, read by one rank, their figures not yet drawn."""
    scene, places = stored_rollouts(directory)
    chosen, main = next(iter(rolled_out(places).items()), ("", directory))
    first, record = [], _survey(main, alone, {})
    if scene and scene.variant and chosen:
        first = [section_on_variants(_table(scene, places, chosen, alone, alone), notes(scene))]
    return [*first, *_read_share(main, alone, alone, record, list(record.provenance)), _cost_section(record)]


def _survey(directory: Path, alone: Comm, scanned: dict[Path, str]) -> Run:
    """What the sections have in common. `scanned`: what is known of numbers that are not finite, by file, so that one
    that several directories link to is read through once."""
    record = Run(seconds=read_stage_seconds(directory))
    for kind in KINDS:
        path = directory / f"{kind}.h5"
        if path.exists():
            with open_product(alone, path, kind) as file:
                record.provenance[kind] = read_provenance(file)
                if path.resolve() not in scanned:
                    scanned[path.resolve()] = not_finite(file, kind)
                if found := scanned[path.resolve()]:
                    record.not_finite[kind] = found
                if kind == "ground_truth":
                    _survey_ground_truth(file, record)
                elif kind == "rollout":
                    _survey_rollout(file, record)
    if not record.provenance:
        raise ProductError(f"{directory}: holds none of {', '.join(f'{kind}.h5' for kind in KINDS)}; "
                           "run `eddies dns SCENE` first")
    record.warnings += [*mixed_products(record.provenance), *changed_truths(record.provenance.get("model", {})),
                        *record.not_finite.values()]
    return record


def _survey_ground_truth(file: File, record: Run) -> None:
    reference, statistics = read_attributes(file, "reference"), read_table(file, "statistics")
    record.cost.append(Metric("dns_seconds_per_step", "DNS: seconds of a step (median, without storing)",
                              float(np.median(statistics["seconds_per_step"]))))
    if "released_at" in reference:
        record.eulerian = read_table(file, "spectra")
    if "stationary" in file:
        with contextlib.suppress(ProductError):  # told in its section
            record.stationary = read_stationary_span(file)


def _survey_rollout(file: File, record: Run) -> None:
    attributes = read_attributes(file, "rollout")
    untimed = "too few steps to time one: the first two, and the first two after a restart, are left out"
    record.cost += [Metric(key, label, attributes.get(key), untimed) for key, label in ROLLOUT_COST.items()]
    record.forced = attributes.get("injection_rate", 0.0) > 0
    if "evaluations" in attributes and attributes["turnovers"] > 0:
        record.cost.append(Metric("storing_share", "rollout: share of the wall time that storing took",
                                  attributes.get("storing_share"), "made by an earlier version"))
        record.cost.append(Metric("evaluations_per_turnover", "evaluations of the forces a turnover",
                                  attributes["evaluations"] / attributes["turnovers"]))


def _read_share(directory: Path, comm: Comm, alone: Comm, record: Run, kinds: Sequence[str]) -> list[Section]:
    """The sections of this rank on products of these kinds, neighbours on the page, without that on the cost; all ranks
    measure the rollout."""
    readers = {"ground_truth": (_read_flow, _read_tracers), "kernel": (_read_kernel,), "model": (_read_model,),
               "step": (_read_step,), "rollout": (None,)}
    parts = [(kind, read) for kind in kinds for read in readers[kind]]

    def sections() -> list[Section]:
        found = []
        for index in np.array_split(np.arange(len(parts)), comm.size)[comm.rank]:
            kind, read = parts[index]
            if kind == "rollout":
                found += _read_part(kind, record, lambda: _rollout_sections(measured.rollout, record))
                continue
            with open_product(alone, directory / f"{kind}.h5", kind) as file:
                found += _read_part(kind, record, lambda: read(file, record))
        return found

    with ExitStack() as files:
        if "rollout" in kinds:
            from eddies.workflows.rollout.measured import open_together  # torch, which all else does without
            measured = files.enter_context(open_together(directory, comm, alone))
            measured.measure(comm, min(comm.size, len(parts)) - 1, late=record.forced and record.stationary is not None)
        return on_all_ranks(comm, lambda: in_files(alone, directory, sections), ProductError)


def _read_part(kind: str, record: Run, read: Callable[[], list[Section]]) -> list[Section]:
    """Sections on a product; where its numbers are not finite and forbid them, one that says so."""
    try:
        return read()
    except (ValueError, OverflowError) as error:  # of a figure's limits, of a PDF, of a number of times
        if not record.not_finite:  # of this product, or of the ground truth, which sections on others take from
            raise
        title = kind.replace("_", " ").capitalize()
        return [Section(kind, title, notices=[f"Not shown ({error}): {'; '.join(record.not_finite.values())}"])]


def _write_report(comm: Comm, output: Path, record: Run, sections: Sequence[Section],
                  links: Sequence[tuple[str, str]], beside: Mapping[Path, str] = MappingProxyType({}),
                  scene: Scene | None = None) -> None:
    """Write the page and the numbers; `scene`: the whole scene, where the page is about it; all ranks call it."""
    in_files(comm, output, lambda: _write_files(
        output, _run_record(output.parent, record, links, scene), sections, beside))


def _tell(record: Run, sections: Sequence[Section]) -> None:
    """Log the titles of sections, what the first ones say, and the main numbers."""
    for section in sections:
        log.info("report: %s, %d figures", section.title, len(section.illustrations))
        if section.key in (VERDICT, VARIANTS):
            log.info("  %s", section.text)
        for metric in section.metrics:
            if metric.key in section.main:
                log.info("  %-60s %s", metric.label, "-" if metric.value is None else shown(metric.value))
    for warning in record.warnings:
        log.warning("report: %s", warning)


def read_stationary_span(file: File) -> StationarySpan:
    """The span of an open ground_truth.h5 over which its stationary state is averaged.

    ProductError where the scene has none ([spin_up] stationary), or one of hardly a step.
    """
    span, scene = read_attributes(file, "stationary"), tomllib.loads(read_provenance(file)["scene"])
    forced_below = scene["forcing"]["wavenumber"] if "forcing" in scene else 0.0
    try:
        return StationarySpan(read_table(file, "statistics"), read_table(file, "spectra_of_statistics")["energy"],
                              read_attributes(file, "reference")["viscosity"], span["start"], span["end"], forced_below)
    except ValueError as error:
        raise ProductError(f"{file.filename}: {error}; raise [spin_up] stationary and run `eddies dns` again") from None


def _read_stationary(file: File, statistics: dict[str, np.ndarray]) -> Section:
    try:
        return stationary.section(statistics, read_stationary_span(file))
    except ProductError as error:
        return Section("stationary", "Stationary turbulence", notices=[str(error)])


def _read_flow(file: File, record: Run) -> list[Section]:
    reference, statistics = read_attributes(file, "reference"), read_table(file, "statistics")
    traced = "released_at" in reference
    name = "filtered" if traced else "final"
    velocity = FieldSeries(file, name).read(-1, "velocity")
    vorticity_magnitude = np.linalg.norm(vorticity(velocity), axis=0)
    middle = velocity.shape[1] // 2
    if traced:
        spectra = record.eulerian
    else:
        wavenumber, energy = energy_spectrum(velocity)
        spectra = {"wavenumber": wavenumber, "energy": energy[None]}
    planes = {"velocity": velocity[0, middle], "vorticity": vorticity_magnitude[middle]}
    sections = [ground_truth.section(ground_truth.StoredFlow(statistics, spectra, reference, planes, name))]
    return sections + ([_read_stationary(file, statistics)] if "stationary" in file else [])


def _read_tracers(file: File, record: Run) -> list[Section]:
    if "particles/tracers" not in file:
        return []
    reference = read_attributes(file, "reference")
    found = tracer_statistics(Trajectory(file, "tracers"), record.eulerian, reference["spacing"])
    power = read_attributes(file, "forcing")["injection_rate"] if "forcing" in file else 0.0
    return [tracers.section(found, reference, power)]


def _read_kernel(file: File, record: Run) -> list[Section]:
    tables = {name: read_table(file, name) for name in ("kernels", "slices", "errors", "history")}
    return [kernel.section(read_json(file, "description")["support"], **tables)]


def _read_step(file: File, record: Run) -> list[Section]:
    return [steps.section(read_attributes(file, "found"),
                          {name: read_table(file, f"trials/{name}") for name in file["trials"]})]


def _read_model(file: File, record: Run) -> list[Section]:
    density_rate = read_table(file, "density_rate_sample") if "density_rate_sample" in file else None
    provenance, errors = record.provenance["model"], read_table(file, "a_priori")
    source, others = provenance.get("source"), others_trained_on(provenance)
    if source and "truths" in source:
        others = [path if reached is None else f"{path} (M_t = {reached:.3f})"
                  for path, reached in source["truths"].items()]
    history = read_table(file, "history") if "history" in file else None
    shown = model_section(read_json(file, "description"), errors,
                          read_table(file, "acceleration_sample"), density_rate, history, source and source["path"],
                          others)
    if source and "source_a_priori" in file:
        own = mach.FlowErrors("this flow", provenance["mach_turbulent"], errors)
        mach.add(shown, own, mach.FlowErrors(source["path"], source["mach_turbulent"],
                                             read_table(file, "source_a_priori")))
    return [shown]


def _rollout_sections(rollout: Rollout, record: Run) -> list[Section]:
    sections = [rollout_section(rollout)]
    if rollout.forced and record.stationary is not None and len(rollout.truth.times):
        sections.append(forced.section(rollout, record.stationary))
    return sections


def _cost_section(record: Run) -> Section:
    metrics = [*record.cost, Metric("stage_seconds", "wall seconds by stage", record.seconds or None,
                                    "no stage_seconds.json: the stages were not run by `eddies`")]
    present = {metric.key for metric in metrics}
    metrics += [Metric(key, label, None, "there is no rollout.h5") for key, label in ROLLOUT_COST.items()
                if key not in present]
    return Section("cost", "Cost", "Wall seconds of stages and of steps.", metrics=metrics,
                   main=("seconds_per_step",))


def _run_record(directory: Path, record: Run, links: Sequence[tuple[str, str]],
                scene: Scene | None) -> RunRecord:
    rows = [("stage", "ranks", "wall time (s)", "date", "eddies", "commit", "libraries")]
    for kind, origin in record.provenance.items():
        stage = MAKER_OF[kind].name
        seconds = shown(record.seconds[stage]) if stage in record.seconds else "not stored"
        commit = origin["commit"][:12] if origin["commit"] else "not a checkout"
        libraries = ", ".join(f"{name} {version}" for name, version in origin["libraries"].items())
        ranks = str(origin["ranks"])
        rows.append((stage, ranks, seconds, origin["date"], origin["eddies"], commit, libraries))
    newest = list(record.provenance.values())[-1]
    text = scene.to_toml() if scene is not None and scene.variant else newest["scene"]
    title = tomllib.loads(text).get("title", "untitled scene")
    return RunRecord(directory.resolve().name, title, text, rows, record.warnings, links)


def _write_files(output: Path, record: RunRecord, sections: Sequence[Section], beside: Mapping[Path, str]) -> None:
    drawn = {f"{illustration.name}.png" for section in sections for illustration in section.illustrations}
    write_page(output, record, sections, {output / "metrics.json": metrics_json(record, sections), **beside})
    for stale in (output / "figures").glob("*.png"):
        if stale.name not in drawn:
            stale.unlink()
