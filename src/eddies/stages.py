"""Runs the stages of a scene in a run directory, skips what is done, and keeps how long each took."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path

from eddies.clock import duration
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.errors import write_error
from eddies.io.hdf5 import in_files, open_product
from eddies.io.provenance import product_fingerprint
from eddies.io.whole_files import write_files
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.pipeline import STAGES, Stage, after
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.feasibility import check_feasible, check_ground_truth, check_places
from eddies.workflows.foreseen.estimates import ground_truth_alone, most_ranks
from eddies.workflows.foreseen.warnings import stage_warnings
from eddies.workflows.learned.source import read_source

log = logging.getLogger("eddies")


def run_stages(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path, resume: bool,
               stop: StopRequest) -> None:
    """Run stages of a scene, all ranks together, and record the wall time of each in stage_seconds.json.

    With `resume`, stages whose product is complete and was made with the same settings are skipped, up to
    the first one that has to run; that one goes on from its newest checkpoint, if it makes any.

    Raises:
        Stopped: `stop` found a reason to; the running stage has kept what --resume needs.
        SceneError: a file STOP asks the job to end before it begins, the scene lacks a section that a stage is about,
            cannot be cut into as many slabs as there are ranks, or differs from that of a product the stages start
            from.
        WriteError: the directory cannot be written.
        ProductError: a stage that is not among `stages` has not left the product that they start from.
    """
    check_feasible(stages, scene, comm)
    check_ranks(stages, scene, comm)
    check_places(stages, comm, directory)
    check_inputs(stages, scene, comm, directory)
    check_stop_file(comm, directory)
    prepare_directory(scene, comm, directory)
    if scene.foreign:
        log.info("%s: uses classes that are not of this package: %s", scene.name, ", ".join(scene.foreign))
    if comm.rank == 0:
        for problem in stage_warnings(scene, stages):
            log.warning(problem)
    known = False  # that the ground truth is what the other stages need
    for stage in [STAGES[name] for name in stages]:
        goes_on, resume = resume, resume and is_done(stage.name, scene, comm, directory)
        if resume or not goes_on:  # left by another run, or by one killed in its last moment
            remove_checkpoints(stage, comm, directory)
        if resume:
            log.info("%s: skipped, %s is complete and made with the same settings", stage.name, stage.file)
            continue
        for later in after(stage.name):  # they start from the product that is about to be replaced
            remove_checkpoints(later, comm, directory)
        if "dns" in stage.depends_on and stage.product is not None and not known:
            rest, known = stages[stages.index(stage.name):], True
            check_ground_truth(rest, scene, comm, directory)
        log.info("%s: starts on %d %s", stage.name, comm.size, "rank" if comm.size == 1 else "ranks")
        start = time.perf_counter()
        module, _, function = stage.run.partition(":")
        run = getattr(import_module(module), function)
        stop.check()
        run(scene, comm, directory, stop)
        comm.Barrier()
        record_seconds(stage.name, time.perf_counter() - start, comm, directory)


def remove_checkpoints(stage: Stage, comm: Comm, directory: Path) -> None:
    """Remove the checkpoints of a stage, if it makes any."""
    if stage.checkpoints is not None:
        CheckpointDirectory(comm, directory / stage.checkpoints, "").remove()


def check_ranks(stages: Sequence[str], scene: Scene, comm: Comm) -> None:
    """Refuse more ranks than the slabs of a scene allow; its ground truth alone may use more than what learns of it."""
    limits = most_ranks(ground_truth_alone(scene) if set(stages) == {"dns"} else scene)
    reason = min(limits, key=lambda name: limits[name])
    if comm.size > limits[reason]:
        raise SceneError(f"{scene.name}: {comm.size} ranks are more than the {limits[reason]} that it can use "
                         f"({reason}); start at most {limits[reason]}, `eddies check` gives all limits")


def check_inputs(stages: Sequence[str], scene: Scene, comm: Comm, directory: Path) -> None:
    """Refuse stages that the scene lacks, and inputs that are missing or of other settings or another form than the
    scene's."""
    for stage in stages:
        if stage not in scene.stages:
            if stage == "train" and scene.model is not None and scene.simulation is not None:
                raise SceneError(f'{scene.name}: [simulation] method = "{scene.simulation.method}" needs no trained '
                                 'model; set method = "learned" to train one')
            raise SceneError(f"{scene.name}: has no [{STAGES[stage].section}], which `eddies {stage}` is about; add it")
    if "train" in stages and scene.model is not None and scene.model.path is not None:
        read_source(scene, comm)
    first = STAGES[stages[0]]
    if first.product is None:  # it works with what there is
        return
    for needed in scene.inputs(first.name):
        with open_product(comm, directory / needed.file, needed.product):
            pass
        if not is_done(needed.name, scene, comm, directory):
            raise SceneError(f"{directory / needed.file}: was made with other settings than this scene's; run "
                             f"`eddies {needed.name}` again with these, or give `eddies {stages[0]}` the --set of then")


def check_stop_file(comm: Comm, directory: Path) -> None:
    """Refuse to start where a file STOP lies: put there between two jobs, it ends a chain that queues itself again."""
    if on_first_rank(comm, (directory / "STOP").exists):
        raise SceneError(f"{directory / 'STOP'}: asks the job to stop before it begins; remove the file to go on")


def prepare_directory(scene: Scene, comm: Comm, directory: Path) -> None:
    """Make the run directory and write the scene as used into it; if rank 0 cannot, all ranks raise."""
    def write() -> None:
        directory.mkdir(parents=True, exist_ok=True)
        write_files({directory / "scene.toml": scene.to_toml()})

    try:
        on_first_rank(comm, write)
    except OSError as error:
        raise write_error(directory, error, f"{directory}: cannot be written ({error.strerror}); choose another "
                          "--output") from None


def is_done(stage: str, scene: Scene, comm: Comm, directory: Path) -> bool:
    """Whether the product of a stage is complete and was made with the same settings, as rank 0 sees it."""
    if STAGES[stage].product is None:
        return False
    product = directory / STAGES[stage].file
    return on_first_rank(comm, lambda: product_fingerprint(product) == scene.fingerprint(stage))


def record_seconds(stage: str, seconds: float, comm: Comm, directory: Path) -> None:
    """Log the wall time of a stage and keep it in stage_seconds.json, which holds the last of each stage."""
    log.info("%s: took %s", stage, duration(seconds))
    path = directory / "stage_seconds.json"
    in_files(comm, path, lambda: write_files(
        {path: json.dumps({**_known_seconds(path), stage: round(seconds, 3)}, indent=2) + "\n"}))


def _known_seconds(path: Path) -> dict[str, float]:
    """What an earlier run noted; a file that is missing or damaged holds nothing worth an error."""
    try:
        known = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}
