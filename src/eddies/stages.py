"""Runs the stages of a scene in a run directory, skips those that are done, and records their wall times."""

import hashlib
import json
import logging
import os
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.errors import WriteError
from eddies.io.hdf5 import in_files, open_product
from eddies.io.provenance import product_fingerprint
from eddies.io.run_lock import RunInUse, lock_directory
from eddies.io.new_files import write_files, writing_failed
from eddies.parallel.broadcast import all_arrive, on_first_rank, require_same
from eddies.logs import OUTCOME
from eddies.parallel.communicator import Comm, warn_of_few_processors
from eddies.parallel.reduction import any_rank
from eddies.parallel.stop import Stopped, StopRequest
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.learned.source import ModelDefinition, read_source
from eddies.workflows.problems import check_ground_truth, directory_problems, memory_of_node, problems
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance
from eddies.workflows.run_directory.work import FAILURE, SECONDS, find_work, link_products, stage_seconds
from eddies.workflows.variants import Step, steps

log = logging.getLogger("eddies")


class VariantsFailed(UserError):
    """Some variants of a scene failed."""


def run_stages(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path, stop: StopRequest,
               overwrite: bool = False, variants: Sequence[str] = ()) -> None:
    """Run stages of a scene, for all its variants or those named in `variants`; all ranks call it.

    A stage is skipped if its product is complete and was made with the same settings. Otherwise it continues from a
    checkpoint of the same settings, if there is one. Work of other settings is replaced only if `overwrite` is true.
    The wall time of each stage is recorded in stage_seconds.json. A lock keeps other jobs out of the directory. The
    failure of a variant does not stop the other variants.

    Raises:
        Stopped: `stop` asked the job to end; the running stage has stored what the next run needs.
        SceneError: a file STOP is present at the start, or the scene lacks a section, cannot use this number of ranks,
            needs a file that is too large for rank 0 to write, or has settings that differ from those of an input.
        RunInUse: another job works in the directory.
        WouldReplaceWork: work of other settings would be replaced.
        WriteError: the directory cannot be written.
        ProductError: an input is missing that `stages` do not make.
        VariantsFailed: variants failed; the products of the others are complete.
    """
    if scene.of_tracks:
        from eddies.workflows.tracks import with_tracks  # imports torch
        scene = with_tracks(scene, comm)
    require_same_work(scene, stages, directory, variants, comm)
    warn_of_few_processors(comm)
    planned = plan(scene, stages, directory, variants)
    warnings = refuse_problems(scene, planned, stages, directory, comm)
    with lock_directory(comm, directory):
        for step in planned:
            in_files(comm, step.directory, partial(
                find_work, step.stages, step.scene, step.directory, step.links, overwrite))
        prepare_directory(scene.to_toml(), comm, directory)
        for warning in warnings if comm.rank == 0 else ():
            log.warning(warning)
        failures = run_steps(planned, directory, comm, stop, overwrite)
        if "report" in stages:
            run_stage("report", (directory, comm, variants, stop), comm, directory, stop, False)
    if failures:
        raise VariantsFailed(f"{scene.name}: variants failed: " + "; ".join(
            f"{name} ({failure})" for name, failure in failures.items()))


def require_same_work(scene: Scene, stages: Sequence[str], directory: Path, variants: Sequence[str],
                      comm: Comm) -> None:
    """Raise UserError unless all ranks have the same scene, with the same files, and the same stages, directory and
    variants."""
    settings = [scene.to_toml(), *(stage_fingerprint(scene, stage) for stage in scene.stages), str(directory), *stages,
                *variants]
    require_same(comm, hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:16],
                 "a scene, stages and a directory with the SHA-256 {}")


def plan(scene: Scene, stages: Sequence[str], directory: Path, variants: Sequence[str]) -> list[Step]:
    """Return the steps of a run. Raise SceneError for an unknown variant, for a stage that a scene does not ask for, or
    if a model is trained on a realisation."""
    scene.check_variants(variants)
    scene.check_unseen(directory)
    planned = steps(scene, stages, directory, variants)
    if not scene.variant or not planned and "report" not in stages:
        for each in [scene.variant[name] for name in variants] or [scene]:
            each.check_stages(stages)
    return planned


def refuse_problems(scene: Scene, planned: Sequence[Step], stages: Sequence[str], directory: Path,
                    comm: Comm) -> list[str]:
    """Raise SceneError for a problem that is known before the run, also for a file STOP. Raise ProductError if an input
    is missing that no step makes. Return the warnings."""
    refused, warnings = problems(scene, planned, comm, memory_of_node(comm))
    for problem in [*refused, *(directory_problems(("report",), comm, directory) if "report" in stages else ())]:
        raise SceneError(problem)
    made = {file for step in planned for file in step.files}
    for step in planned:
        check_inputs(step, comm, made)
    if on_first_rank(comm, lambda: os.path.exists(directory / "STOP")):  # ends a chain of jobs that resubmit themselves
        raise SceneError(f"{directory / 'STOP'}: asks the job to stop before it begins; remove the file to continue")
    return warnings


def run_steps(planned: Sequence[Step], directory: Path, comm: Comm, stop: StopRequest,
              overwrite: bool) -> dict[str, str]:
    """Run steps in order and return the errors of variants that failed, by name. The later steps of such a variant are
    left out. The caller holds the lock of the run directory."""
    failures: dict[str, str] = {}
    for number, step in enumerate(planned, 1):
        if step.variant in failures:
            continue
        if len(planned) > 1:
            log.info("%s, part %d of %d: %s", step.directory, number, len(planned), ", ".join(step.stages))
        inner = step.directory != directory  # this directory has a lock of its own
        with (recording_failure(failures, step.variant, step.directory, comm),
              lock_directory(comm, step.directory) if inner else nullcontext()):
            if inner:
                linked = {holder / STAGES[stage].file: stage_fingerprint(step.scene, stage)
                          for stage, holder in step.links.items()}
                in_files(comm, step.directory, partial(link_products, linked, step.directory))
                prepare_directory(step.scene.to_toml(), comm, step.directory)
            run_step(step, comm, stop, overwrite)
    return failures


@contextmanager
def recording_failure(failures: dict[str, str], variant: str | None, directory: Path, comm: Comm) -> Iterator[None]:
    """Context for the work on a variant. If all ranks raise a UserError, only this work ends, and other variants go on.

    The error is stored in `failures` under the name `variant`, and written into `directory`. If `variant` is None, the
    work is for all variants, and its error is raised.
    """
    errors = comm.Dup()  # other ranks may wait in `comm` for a message when one rank fails
    try:
        yield
    except (WriteError, RunInUse):  # these concern all variants
        raise
    except UserError as error:
        if variant is None or not all_arrive(errors) or any_rank(errors, writing_failed()):
            raise  # if HDF5 could not write a file, the job must be aborted
        failures[variant] = str(error)
        log.log(OUTCOME, "variant %s failed: %s", variant, error)
        in_files(comm, directory, lambda: write_files({directory / FAILURE: f"{failures[variant]}\n"}))
    errors.Free()


def run_step(step: Step, comm: Comm, stop: StopRequest, overwrite: bool) -> None:
    """Run the stages of a step that are not done yet. The caller holds the lock of the step's directory."""
    scene, directory = step.scene, step.directory
    if step.links:  # the other inputs were checked before the first step
        check_inputs(step, comm)
    work = in_files(comm, directory, lambda: find_work(step.stages, scene, directory, step.links, overwrite))
    if scene.foreign:
        log.info("%s: uses classes from outside this package: %s", scene.name, ", ".join(scene.foreign))
    checked = False  # whether the ground truth was checked for the stages that need it
    for number, name in enumerate(step.stages):
        stage = STAGES[name]
        action = work.actions[name]
        if action.drops and stage.checkpoints is not None:
            CheckpointDirectory(comm, directory / stage.checkpoints, "").remove()
        if action.start == "skip":
            log.info("%s: skipped, %s is complete and made with the same settings", name, stage.file)
            if name == "train-kernel" and scene.kernel is not None:
                from eddies.workflows.train_kernel import keep_form  # imports torch
                keep_form(comm, directory / stage.file, scene.kernel.form, stage_provenance(scene, name))
            continue
        if scene.tracers is not None and "dns" in stage.depends_on and not checked:
            check_ground_truth(directory / STAGES["dns"].file, step.stages[number:], scene, comm)
            checked = True
        run_stage(name, (scene, comm, directory, stop), comm, directory, stop, action.start == "continue")


def run_stage(name: str, arguments: Sequence[Any], comm: Comm, directory: Path, stop: StopRequest,
              begun: bool) -> None:
    """Run one stage and record its wall time, also if it is stopped. `arguments` are those of the function `run` in the
    module of the stage. If `begun` is true, the stage continues from a checkpoint, and its time is added to that of
    earlier runs."""
    log.info("%s: starts on %d %s", name, comm.size, "rank" if comm.size == 1 else "ranks")
    start = time.perf_counter()
    # The report has run(directory, comm, variants, stop), the other stages have run(scene, comm, directory, stop).
    run = import_module(f"eddies.workflows.{name.replace('-', '_')}").run
    stop.check()
    if not begun:
        record_seconds(name, None, comm, directory)
    try:
        run(*arguments)
        comm.Barrier()
    except Stopped:
        record_seconds(name, time.perf_counter() - start, comm, directory)
        raise
    seconds = record_seconds(name, time.perf_counter() - start, comm, directory)
    log.info("%s: took %s", name, duration(seconds))


def check_inputs(step: Step, comm: Comm, made: Collection[Path] = ()) -> None:
    """Raise SceneError or ProductError if an input of a step is missing, unusable or made with other settings.

    Files in `made`, which the same job makes first, are not checked.
    """
    stages, scene = step.stages, step.scene
    weights = scene.model.weights_file if "train" in stages and scene.model is not None else None
    if weights is not None and weights not in made:
        read_source(scene.name, ModelDefinition.of(scene), comm)
    for needed in scene.inputs(stages[0]):
        holder = step.links.get(needed.name, step.directory)
        if holder / needed.file in made:
            continue
        with open_product(comm, holder / needed.file, needed.product):
            pass
        made_with = on_first_rank(comm, partial(product_fingerprint, holder / needed.file))
        if made_with != stage_fingerprint(scene, needed.name):
            raise SceneError(f"{holder / needed.file}: was made with settings that differ from this scene's; run "
                             f"`eddies {needed.name} SCENE --overwrite`, or give `eddies {stages[0]}` the --set "
                             "options with which the file was made")


def prepare_directory(text: str, comm: Comm, directory: Path) -> None:
    """Write the text of the scene into a run directory. Remove unfinished files of killed jobs and the error of an
    earlier failure; collective."""
    def write() -> None:
        for leftover in directory.glob("*.partial"):
            leftover.unlink()
        (directory / FAILURE).unlink(missing_ok=True)
        write_files({directory / "scene.toml": text})

    in_files(comm, directory, write)


def record_seconds(stage: str, seconds: float | None, comm: Comm, directory: Path) -> float:
    """Add `seconds` to the wall time of a stage in stage_seconds.json and return the sum; None removes the time of a
    stage that starts from its beginning. The sum lacks the time of runs that were killed or failed."""
    path = directory / SECONDS

    def record() -> float:
        recorded = stage_seconds(directory)
        whole = recorded.get(stage, 0.0) + (seconds or 0.0)
        if seconds is not None:
            recorded[stage] = round(whole, 3)
        elif recorded.pop(stage, None) is None:
            return whole
        write_files({path: json.dumps(recorded, indent=2) + "\n"})
        return whole

    return in_files(comm, path, record)
