"""Runs the stages of a scene in a run directory, skips what is done, and keeps how long each took."""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Collection, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from functools import partial
from importlib import import_module
from pathlib import Path

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.errors import WriteError
from eddies.io.hdf5 import in_files, open_product
from eddies.io.run_lock import RunInUse, RunTakenOver, lock_directory, refuse_if_held
from eddies.io.new_files import LARGEST_BYTES, has_single_writer, write_files
from eddies.parallel.broadcast import on_first_rank, require_same
from eddies.logs import OUTCOME
from eddies.parallel.communicator import Comm, warn_of_few_processors
from eddies.parallel.connection import all_arrive
from eddies.parallel.stop import Stopped, StopRequest
from eddies.pipeline import STAGES, Stage
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.foreseen.storage import in_units
from eddies.workflows.learned.source import read_source
from eddies.workflows.problems import Context, check_ground_truth, memory_of_node, refuse
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import FAILURE, SECONDS, Work, find_work, is_done, stage_seconds
from eddies.workflows.variants import Step, check_unseen, link, steps

log = logging.getLogger("eddies")

# Where the functions are that do the stages, each as run(scene, comm, directory, stop); imported once it is their turn.
RUN = {"dns": "eddies.workflows.dns:run", "train-kernel": "eddies.workflows.train_kernel:run",
       "train": "eddies.workflows.train:run", "find-step": "eddies.workflows.find_step:run",
       "simulate": "eddies.workflows.simulate:run",
       "report": "eddies.workflows.report:run_stage"}


class VariantsFailed(UserError):
    """Some variants of a scene did not come to their end."""


def run_stages(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path, stop: StopRequest,
               overwrite: bool = False, take_over: bool = False, variants: Sequence[str] = ()) -> None:
    """Run stages of a scene, of all its variants or of those named, all ranks together.

    Stages whose product is complete and was made with the same settings are skipped; one with a checkpoint of the same
    settings goes on from it. Work of other settings is replaced with `overwrite` alone. The wall time of each stage is
    recorded in stage_seconds.json. Meanwhile no other job works in the directory; one that seems to is ended with
    `take_over`. A variant that fails does not keep the others from their end.

    Raises:
        Stopped: `stop` found a reason to; the running stage has kept what the next run needs.
        SceneError: a file STOP asks the job to end before it begins, the scene lacks a section that a stage is about,
            cannot be cut into as many slabs as there are ranks, makes a file too large for rank 0 to write for all, or
            differs from that of a product the stages start from.
        RunInUse, RunTakenOver: another job works in the directory, or has taken it over.
        WorkAtStake: work of other settings would be replaced.
        WriteError: the directory cannot be written.
        ProductError: a stage that is not among `stages` has not left the product that they start from.
        VariantsFailed: variants failed; what the others made is there.
    """
    settings = [scene.to_toml(), *(stage_fingerprint(scene, stage) for stage in scene.stages), str(directory), *stages,
                *variants]
    require_same(comm, hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:16],
                 "a scene, stages and a directory of which the SHA-256 is {}")
    warn_of_few_processors(comm)
    scene.check_variants(variants)
    check_unseen(scene, directory)
    planned, reported = steps(scene, stages, directory, variants), "report" in stages
    for step in planned:
        check_sections(step.stages, step.scene)
    if not planned and not reported:
        for each in [scene.variant[name] for name in variants] or [scene]:
            check_sections(stages, each)
    warnings = refuse(scene, Context(comm, stages, directory, variants, memory_of_node()))
    if take_over:
        for step in planned:
            look_at_work(step, comm, overwrite)  # a command that is refused ends no other job
    else:
        refuse_if_held(comm, directory)
    check_made(planned, comm)
    check_stop_file(comm, directory)
    with working_in(comm, directory, stop, take_over):
        for step in planned:
            look_at_work(step, comm, overwrite)
        prepare_directory(scene, comm, directory)
        for warning in warnings if comm.rank == 0 else ():
            log.warning(warning)
        failures = run_steps(planned, comm, directory, stop, overwrite, take_over)
        if reported:
            run_stage(STAGES["report"], scene, comm, directory, stop, False, variants=variants)
    if failures:
        raise VariantsFailed(f"{scene.name}: variants failed: " + "; ".join(
            f"{name} ({failure})" for name, failure in failures.items()))


def run_steps(planned: Sequence[Step], comm: Comm, directory: Path, stop: StopRequest, overwrite: bool,
              take_over: bool) -> dict[str, str]:
    """Run the steps of a run directory, which is held, one after the other; returns why variants failed, by name."""
    failures: dict[str, str] = {}
    errors = comm.Dup()  # ranks that do not know of a failure may wait for a message on the other one
    for number, step in enumerate(planned, 1):
        if step.variant in failures:
            continue
        if len(planned) > 1:
            log.info("%s, %d of %d: %s", step.directory, number, len(planned), ", ".join(step.stages))
        if step.directory == directory:
            holding: AbstractContextManager[None] = nullcontext()
        else:
            holding = working_in(comm, step.directory, stop, take_over)
        try:
            with holding:
                in_files(comm, step.directory, lambda: link(step))
                if step.directory != directory:
                    prepare_directory(step.scene, comm, step.directory)
                run_step(step, comm, stop, overwrite)
        except (WriteError, RunInUse, RunTakenOver):  # these concern all variants
            raise
        except UserError as error:
            if step.variant is None or not all_arrive(errors):
                raise
            failures[step.variant] = str(error)
            log.log(OUTCOME, "variant %s failed: %s", step.variant, error)
            text = f"{error}\n"
            in_files(comm, step.directory, lambda: write_files({step.directory / FAILURE: text}))
    errors.Free()
    return failures


def run_step(step: Step, comm: Comm, stop: StopRequest, overwrite: bool) -> None:
    """Run the stages of a step that are not done, in its directory, which is held."""
    if step.links:  # else checked before any step
        check_inputs(step, comm)
    work = look_at_work(step, comm, overwrite)
    if has_single_writer(comm):
        log.info("rank 0 writes for all, up to %s a file: this h5py is built without MPI", in_units(LARGEST_BYTES))
    if step.scene.foreign:
        log.info("%s: uses classes that are not of this package: %s", step.scene.name, ", ".join(step.scene.foreign))
    known = False  # that the ground truth is what the other stages need
    for stage in [STAGES[name] for name in step.stages]:
        if stage.name in work.useless:
            remove_checkpoints(stage, comm, step.directory)
        if stage.name in work.done:
            log.info("%s: skipped, %s is complete and made with the same settings", stage.name, stage.file)
            if stage.name == "train-kernel":
                from eddies.workflows.train_kernel import keep_form  # torch, only here
                keep_form(step.scene, comm, step.directory)
            continue
        if "dns" in stage.depends_on and not known:
            rest, known = step.stages[step.stages.index(stage.name):], True
            check_ground_truth(rest, step.scene, comm, step.directory)
        run_stage(stage, step.scene, comm, step.directory, stop, stage.name in work.begun)


def look_at_work(step: Step, comm: Comm, overwrite: bool) -> Work:
    """What a step finds in its directory; WorkAtStake where it would replace it and may not `overwrite`."""
    work = in_files(comm, step.directory, lambda: find_work([*step.links, *step.stages], step.scene, step.directory))
    if not overwrite:
        work.refuse_to_lose()
    return work


def check_made(planned: Sequence[Step], comm: Comm) -> None:
    """Refuse steps that start from a product which neither they make nor an earlier job has made."""
    making = {(stage, step.directory) for step in planned for stage in step.stages}
    for step in planned:
        check_inputs(step, comm, making)


@contextmanager
def working_in(comm: Comm, directory: Path, stop: StopRequest, take_over: bool) -> Iterator[None]:
    """Hold a directory, so that no other job works there, and end with the next look of `stop` if one takes it over."""
    with lock_directory(comm, directory, take_over) as loss, stop.watching(loss):
        yield


def run_stage(stage: Stage, scene: Scene, comm: Comm, directory: Path, stop: StopRequest, begun: bool,
              **more: Sequence[str]) -> None:
    """Run one stage, and record its wall time, also when it is stopped: if it was `begun` before, that is added.
    `more` are further arguments of the stage."""
    log.info("%s: starts on %d %s", stage.name, comm.size, "rank" if comm.size == 1 else "ranks")
    start = time.perf_counter()
    module, _, function = RUN[stage.name].partition(":")
    run = getattr(import_module(module), function)
    stop.check()
    try:
        run(scene, comm, directory, stop, **more)
        comm.Barrier()
    except Stopped:
        record_seconds(stage.name, time.perf_counter() - start, comm, directory, begun)
        raise
    seconds = record_seconds(stage.name, time.perf_counter() - start, comm, directory, begun)
    log.info("%s: took %s", stage.name, duration(seconds))


def remove_checkpoints(stage: Stage, comm: Comm, directory: Path) -> None:
    """Remove the checkpoints of a stage, if it makes any."""
    if stage.checkpoints is not None:
        CheckpointDirectory(comm, directory / stage.checkpoints, "").remove()


def check_sections(stages: Sequence[str], scene: Scene) -> None:
    """Refuse stages that the scene lacks."""
    for stage in stages:
        if stage not in scene.stages:
            if stage == "train" and scene.model is not None and scene.simulation is not None:
                raise SceneError(f'{scene.name}: [simulation] method = "{scene.simulation.method}" needs no trained '
                                 'model; set method = "learned" to train one')
            raise SceneError(f"{scene.name}: has no [{STAGES[stage].section}], which `eddies {stage}` is about; add it")


def check_inputs(step: Step, comm: Comm, making: Collection[tuple[str, Path]] = ()) -> None:
    """Refuse stages that the scene of a step lacks, and inputs that are missing, of other settings or of another form.

    `making` names the inputs that the same job makes first, by stage and directory. They are not checked.
    """
    stages, scene = step.stages, step.scene
    check_sections(stages, scene)
    weights = scene.model.weights_file if "train" in stages and scene.model is not None else None
    if weights is not None and ("train", weights.parent) not in making:
        read_source(scene, comm)
    if "train" in stages and scene.training is not None and scene.training.truths is not None:
        from eddies.workflows.learned.truths import truth_problems  # torch, only here
        for problem in truth_problems(scene, comm, step.holder("dns")):
            raise SceneError(f"{scene.name}: {problem}")
    for needed in scene.inputs(stages[0]):
        holder = step.holder(needed.name)
        if (needed.name, holder) in making:
            continue
        with open_product(comm, holder / needed.file, needed.product):
            pass
        if not on_first_rank(comm, partial(is_done, needed.name, scene, holder)):
            raise SceneError(f"{holder / needed.file}: was made with other settings than this scene's; run "
                             f"`eddies {needed.name} --overwrite` with these, or give `eddies {stages[0]}` the --set "
                             "of then")


def check_stop_file(comm: Comm, directory: Path) -> None:
    """Refuse to start where a file STOP lies: put there between two jobs, it ends a chain that queues itself again."""
    if on_first_rank(comm, lambda: os.path.exists(directory / "STOP")):
        raise SceneError(f"{directory / 'STOP'}: asks the job to stop before it begins; remove the file to go on")


def prepare_directory(scene: Scene, comm: Comm, directory: Path) -> None:
    """Write the scene as used into the run directory, and remove what jobs that were killed left unfinished there; if
    rank 0 cannot, all ranks raise."""
    def write() -> None:
        for leftover in directory.glob("*.partial"):
            leftover.unlink()
        (directory / FAILURE).unlink(missing_ok=True)
        write_files({directory / "scene.toml": scene.to_toml()})

    in_files(comm, directory, write)


def record_seconds(stage: str, seconds: float, comm: Comm, directory: Path, begun: bool) -> float:
    """Keep the wall time of a stage in stage_seconds.json, which holds that of each, and give it: of all its runs, as
    far as they were not killed, if it was `begun` before."""
    path = directory / SECONDS

    def record() -> float:
        known = stage_seconds(directory)
        whole = seconds + (known.get(stage, 0.0) if begun else 0.0)
        write_files({path: json.dumps({**known, stage: round(whole, 3)}, indent=2) + "\n"})
        return whole

    return in_files(comm, path, record)
