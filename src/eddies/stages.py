"""Runs the stages of a scene in a run directory, skips what is done, and keeps how long each took."""

import json
import logging
import os
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

import numpy as np

from eddies.clock import duration
from eddies.io.checkpoint import DIRECTORIES, CheckpointDirectory
from eddies.io.hdf5 import open_product, product_fingerprint
from eddies.parallel.stop import StopRequest
from eddies.scene import Scene, SceneError
from eddies.workflows.estimates import ground_truth_alone, most_ranks
from eddies.workflows.model_source import read_source

log = logging.getLogger("eddies")

# The product of each stage, in order: kind, then file name. A stage reads the products before its own.
PRODUCTS = {"dns": ("ground_truth", "ground_truth.h5"), "train-kernel": ("kernel", "kernel.h5"),
            "train": ("model", "model.h5"), "simulate": ("rollout", "rollout.h5")}


def run_stages(stages: Sequence[str], scene: Scene, comm, directory: Path, resume: bool,
               stop: StopRequest) -> None:
    """Run stages of a scene, all ranks together, and record the wall time of each in stage_seconds.json.

    With `resume`, stages whose product is complete and was made with the same settings are skipped, up to
    the first one that has to run; that one goes on from its newest checkpoint, if it makes any.

    Raises:
        Stopped: `stop` found a reason to; the running stage has kept what --resume needs.
        SceneError: a file STOP asks the job to end before it begins, the scene lacks a section that a stage is about,
            cannot be cut into as many slabs as there are ranks, differs from that of a product the stages start from,
            or the directory cannot be written.
        ProductError: a stage that is not among `stages` has not left the product that they start from.
    """
    check_ranks(stages, scene, comm)
    check_inputs(stages, scene, comm, directory)
    check_stop_file(comm, directory)
    prepare_directory(scene, comm, directory)
    if scene.foreign:
        log.info("%s: uses classes that are not of this package: %s", scene.name, ", ".join(scene.foreign))
    for stage in stages:
        goes_on, resume = resume, resume and is_done(stage, scene, comm, directory)
        # Left by another run, or by one killed in its last moment.
        if stage in DIRECTORIES and (resume or not goes_on):
            CheckpointDirectory(comm, directory / DIRECTORIES[stage], "").remove()
        if resume:
            log.info("%s: skipped, %s is complete and made with the same settings", stage, PRODUCTS[stage][1])
            continue
        remove_later_checkpoints(stage, comm, directory)
        log.info("%s: starts on %d %s", stage, comm.size, "rank" if comm.size == 1 else "ranks")
        start = time.perf_counter()
        workflow = import_module(f"eddies.workflows.{stage.replace('-', '_')}")
        stop.check()
        if stage == "report":
            workflow.run(directory, comm)
        else:
            workflow.run(scene, comm, directory, stop)
        comm.Barrier()
        record_seconds(stage, time.perf_counter() - start, comm, directory)


def remove_later_checkpoints(stage: str, comm, directory: Path) -> None:
    """Remove the checkpoints of the stages that start from the product which a stage is about to replace."""
    order = list(PRODUCTS)
    for later in order[order.index(stage) + 1:] if stage in order else ():
        if later in DIRECTORIES:
            CheckpointDirectory(comm, directory / DIRECTORIES[later], "").remove()


def check_ranks(stages: Sequence[str], scene: Scene, comm) -> None:
    """Refuse more ranks than the slabs of a scene allow; its ground truth alone may use more than what learns of it."""
    limits = most_ranks(ground_truth_alone(scene) if set(stages) == {"dns"} else scene)
    reason = min(limits, key=limits.get)
    if comm.size > limits[reason]:
        raise SceneError(f"{scene.name}: {comm.size} ranks are more than the {limits[reason]} that it can use "
                         f"({reason}); start at most {limits[reason]}, `eddies check` gives all limits")


def check_inputs(stages: Sequence[str], scene: Scene, comm, directory: Path) -> None:
    """Refuse stages that the scene lacks, and inputs that are missing or of other settings or another form than the
    scene's."""
    for stage in stages:
        if stage not in scene.stages:
            if stage == "train" and scene.model is not None:
                raise SceneError(f'{scene.name}: [simulation] method = "{scene.simulation.method}" needs no trained '
                                 'model; set method = "learned" to train one')
            section = {"train-kernel": "kernel", "train": "model", "simulate": "simulation"}[stage]
            raise SceneError(f"{scene.name}: has no [{section}], which `eddies {stage}` is about; add it")
    if "train" in stages and scene.model.path is not None:
        read_source(scene, comm)
    order = list(PRODUCTS)
    earlier = order[:order.index(stages[0])] if stages[0] in order else ()
    for needed in [stage for stage in earlier if stage in scene.stages]:
        kind, name = PRODUCTS[needed]
        with open_product(comm, directory / name, kind):
            pass
        if not is_done(needed, scene, comm, directory):
            raise SceneError(f"{directory / name}: was made with other settings than this scene's; run "
                             f"`eddies {needed}` again with these, or give `eddies {stages[0]}` the --set of then")


def check_stop_file(comm, directory: Path) -> None:
    """Refuse to start where a file STOP lies: put there between two jobs, it ends a chain that queues itself again."""
    if verdict_of_first_rank((directory / "STOP").exists(), comm):
        raise SceneError(f"{directory / 'STOP'}: asks the job to stop before it begins; remove the file to go on")


def prepare_directory(scene: Scene, comm, directory: Path) -> None:
    """Make the run directory and write the scene as used into it; if rank 0 cannot, all ranks raise."""
    problem = None
    if comm.rank == 0:
        try:
            directory.mkdir(parents=True, exist_ok=True)
            (directory / "scene.toml").write_text(scene.to_toml(), encoding="utf-8")
        except OSError as error:
            problem = error.strerror
    if verdict_of_first_rank(problem is not None, comm):
        raise SceneError(f"{directory}: cannot be written ({problem}); choose another --output")


def is_done(stage: str, scene: Scene, comm, directory: Path) -> bool:
    """Whether the product of a stage is complete and was made with the same settings, as rank 0 sees it."""
    if stage not in PRODUCTS:
        return False
    fingerprint = product_fingerprint(directory / PRODUCTS[stage][1])
    return verdict_of_first_rank(fingerprint == scene.fingerprint(stage), comm)


def verdict_of_first_rank(verdict: bool, comm) -> bool:
    """Rank 0's answer on every rank."""
    shared = np.array([verdict], np.int8)
    comm.Bcast(shared)
    return bool(shared[0])


def record_seconds(stage: str, seconds: float, comm, directory: Path) -> None:
    """Log the wall time of a stage and keep it in stage_seconds.json, which holds the last of each stage."""
    log.info("%s: took %s", stage, duration(seconds))
    if comm.rank == 0:
        path = directory / "stage_seconds.json"
        partial = path.with_name(path.name + ".partial")
        partial.write_text(json.dumps({**_known_seconds(path), stage: round(seconds, 3)}, indent=2) + "\n")
        os.replace(partial, path)


def _known_seconds(path: Path) -> dict[str, float]:
    """What an earlier run noted; a file that is missing or damaged holds nothing worth an error."""
    try:
        known = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}
