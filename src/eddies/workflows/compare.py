"""Error against run time: the variants of a scene, run one after the other from the same moment of one ground truth.

Every variant has a run directory, so that `eddies report` can show each of them in full.
"""

from __future__ import annotations

import csv
import io
import json
import logging
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from itertools import chain
from pathlib import Path
from shlex import quote
from typing import Any

from eddies.io.hdf5 import ProductError, in_files, open_product, read_attributes
from eddies.io.provenance import read_provenance
from eddies.io.run_lock import refuse_if_held
from eddies.parallel.communicator import Comm
from eddies.report.comparison import ErrorAgainstTime, run_record, sections
from eddies.report.figures import draw
from eddies.report.page import Section, write_page
from eddies.scene.comparison import BASELINE, Comparison
from eddies.scene.scene import SceneError
from eddies.workflows.variants.rows import COLUMNS, machine, notes, rows
from eddies.workflows.variants.run import RunStages, VariantRun, in_directories

log = logging.getLogger("eddies")


def run(comparison: Comparison, comm: Comm, output: Path, overwrite: bool, take_over: bool,
        hold: Callable[[], AbstractContextManager[None]], run_stages: RunStages) -> None:
    """Run every variant and write comparison.csv, comparison.json, figures and index.html; all ranks call it.

    A variant that fails does not end the comparison: its row says when and why. Rollouts that are there, made with the
    same settings on as many ranks, are kept. `hold` keeps other jobs out of the directory.

    Raises:
        ProductError, SceneError: a ground truth is missing, or does not fit the comparison; or the run directory of a
            variant holds what no comparison has made. Nothing is written then.
        WorkAtStake: without `overwrite`, where work of other settings or numbers of ranks would be replaced.
        RunInUse: another job works in the directory, or in that of a variant.
    """
    runs_of = {name: [VariantRun(plan.scene, plan.directory, plan.ground_truth)
                      for plan in comparison.runs_of(name, output)] for name in comparison.scenes}
    runs = [*chain.from_iterable(runs_of.values())]
    in_directories(comm, lambda: check_directories(runs))
    for variant in runs:
        check_ground_truth(comparison, variant, comm)
    for variant in runs:
        look_at(variant, comm, overwrite, take_over)
    with hold():
        run_all(comparison, runs, comm, overwrite, take_over, run_stages)
        alone = comm.Split(comm.rank)
        try:
            table = in_files(comm, output, lambda: rows(comparison, runs_of, alone, comm.size))
        finally:
            alone.Free()
        write(comparison, table, reference_of(comparison, comm), comm, output)


def look_at(variant: VariantRun, comm: Comm, overwrite: bool, take_over: bool) -> None:
    """Refuse a variant's directory in which another job works, or work would be replaced, where that may not be."""
    if not take_over:
        refuse_if_held(comm, variant.directory)
    if not overwrite:
        in_directories(comm, lambda: variant.work(comm.size).refuse_to_lose())


def run_all(comparison: Comparison, runs: Sequence[VariantRun], comm: Comm, overwrite: bool, take_over: bool,
            run_stages: RunStages) -> None:
    """Roll all variants out, then time them in rounds."""
    errors = comm.Dup()
    for done, variant in enumerate(runs):
        log.info("compare: %s, %d of %d", variant.directory, done + 1, len(runs))
        look_at(variant, comm, overwrite, take_over)  # once more: hours may have passed
        in_directories(comm, lambda: variant.prepare(runs[:done], comm.size))
        variant.attempt(errors, lambda: variant.roll_out(run_stages))
    for repeat in range(1, comparison.repeats):
        log.info("compare: timing, round %d of %d", repeat + 1, comparison.repeats)
        for variant in runs:
            if variant.failure is None and "simulate" in variant.stages:
                variant.attempt(errors, lambda: variant.time_block(comm, run_stages))
    errors.Free()


def check_directories(runs: Sequence[VariantRun]) -> None:
    """Refuse run directories of variants in which something of others would be replaced; one rank calls it."""
    for variant in runs:
        variant.check_directory([other.ground_truth for other in runs])


def check_ground_truth(comparison: Comparison, variant: VariantRun, comm: Comm) -> None:
    """Refuse a ground truth that is missing, of other settings than the variant's, or of too coarse frames."""
    path, simulation = variant.ground_truth / "ground_truth.h5", variant.scene.simulation
    changes = "".join(f" --set {quote(change)}" for change in comparison.changes_of_the_flow(variant.name))
    seed = "" if variant.scene.seed == comparison.base_scene.seed else f" --set seed={variant.scene.seed}"
    remedy = f"make it with `eddies dns {comparison.base}{changes}{seed} --output {variant.ground_truth}`"
    try:
        with open_product(comm, path, "ground_truth") as file:
            fingerprint = read_provenance(file).get("fingerprint")
            kolmogorov_time = read_attributes(file, "reference")["kolmogorov_time"]
    except ProductError as error:
        raise ProductError(f"{error}: {remedy}, or give --run with another run directory") from None
    if fingerprint != variant.scene.fingerprint("dns"):
        raise SceneError(f'{path}: was made with other settings than those of variant "{variant.name}"; {remedy}, or '
                         "give --run with another run directory")
    if simulation is not None and simulation.frame_interval > kolmogorov_time:
        raise SceneError(f'variant "{variant.name}": [simulation] frame_interval = {simulation.frame_interval:g}: no '
                         f"frame before t_eta = {kolmogorov_time:.3g}, at which errors are compared; lower it")


def reference_of(comparison: Comparison, comm: Comm) -> dict[str, float]:
    """The scales of the ground truth of a comparison's subject."""
    with open_product(comm, comparison.ground_truth_of(comparison.subject) / "ground_truth.h5", "ground_truth") as file:
        return read_attributes(file, "reference")


def write(comparison: Comparison, table: list[dict[str, Any]], flow: dict[str, float], comm: Comm,
          output: Path) -> None:
    """Write the rows, the scales of the flow and what is drawn; all ranks call it.

    Raises WriteError where rank 0 cannot write.
    """
    drawn = ErrorAgainstTime(table, comparison.subject, BASELINE, comparison.columns)
    parts = sections(drawn, comparison.turnovers) if comm.rank == 0 else []
    draw(comm, parts)
    in_directories(comm, lambda: write_files(comparison, drawn, flow, parts, comm.size, output))


def write_files(comparison: Comparison, drawn: ErrorAgainstTime, flow: dict[str, float], parts: Sequence[Section],
                ranks: int, output: Path) -> None:
    """Write rows and summary as CSV and JSON, and the page of drawn sections; one rank calls it."""
    computer = machine(comparison.base_scene.device, ranks)
    lines = io.StringIO(newline="")
    writer = csv.DictWriter(lines, COLUMNS)
    writer.writeheader()
    writer.writerows(drawn.rows)
    record = {"name": comparison.name, "title": comparison.title, "machine": computer, "flow": flow,
              "rows": drawn.rows, "summary": drawn.summary}
    parts[0].notices += notes(comparison)
    page = run_record(comparison.name, comparison.title, comparison.base_scene.to_toml(), computer)
    write_page(output, page, parts, {
        output / "comparison.csv": lines.getvalue(),
        output / "comparison.json": json.dumps(record, indent=2, allow_nan=False) + "\n"})
    for sentence in drawn.summary:
        log.info("compare: %s", sentence)
