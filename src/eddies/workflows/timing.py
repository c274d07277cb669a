"""`eddies check --time`: wall time of each stage, estimated from a few steps in a temporary directory.

The stages work with a short ground truth of the scene's flow, on the grid of the scene.
"""

from __future__ import annotations

import logging
import math
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from eddies.clock import WARM_UP_STEPS, duration
from eddies.errors import UserError
from eddies.io.hdf5 import in_files
from eddies.io.provenance import product_attributes
from eddies.io.new_files import write_files, writing_failed
from eddies.learning.optimization import Adam
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import Stopped, StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, SceneError, Training
from eddies.workflows import dns, find_step, reconstruct, report, simulate, train, train_kernel
from eddies.workflows.foreseen.numbers import estimate
from eddies.workflows.ground_truth.frame_counts import TESTED_FRAMES
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.training_data import training_data
from eddies.workflows.learned.training_phases import training_phases
from eddies.workflows.learned.truths import open_truths
from eddies.workflows.run_directory.fingerprints import stage_fingerprint
from eddies.workflows.run_directory.work import link_products
from eddies.workflows.variants import steps

log = logging.getLogger("eddies")

RUN = {"dns": dns.run, "train-kernel": train_kernel.run, "reconstruct": reconstruct.run, "train": train.run,
       "find-step": find_step.run, "simulate": simulate.run}
FEW_STEPS = 4                # steps of the kernel training, and frame intervals of the rollout
LEAST_TURNOVERS = 1e-9       # turnovers of a spin-up or ground truth with as few steps as possible


class StepTimes(StopRequest):
    """Records the time of each call. Stages call this object before each step, to ask whether they must stop."""

    def __init__(self, comm: Comm, signals: Sequence[int]) -> None:
        super().__init__(comm, signals)
        self.times: list[float] = []

    def __call__(self) -> bool:
        self.times.append(time.perf_counter())
        return super().__call__()


def run(scene: Scene, comm: Comm, signals: Sequence[int] = ()) -> None:
    """Measure all stages of all variants, and log their seconds per step and their wall time; all ranks call it.

    One short ground truth serves all stages. Raises Stopped after a signal.
    """
    if scene.of_tracks:
        raise SceneError(f"{scene.name}: `eddies check --time` cannot shorten a scene with [tracks]; run the "
                         "scene, and read the times in its report")
    stop = StepTimes(comm, signals)
    log.info("%s: measured on %d %s", scene.name, comm.size, "rank" if comm.size == 1 else "ranks")
    log.info("%-28s    s/step     steps  wall time", "stage")
    few, failed = shortened(scene, None), set()
    try:
        with temporary_directory(comm) as directory:
            if scene.tracers:  # a single frame interval gives the turnover time of the flow
                with quiet():
                    dns.run(few.without_variants, comm, directory, stop)
                # The measured run must not continue this one.
                in_files(comm, directory, lambda: shutil.rmtree(directory / STAGES["dns"].checkpoints,
                                                                ignore_errors=True))
                reference = product_attributes(directory / STAGES["dns"].file, "reference")
                few = shortened(scene, reference["eddy_turnover_time"])
            for step in steps(few, scene.stages_of_all, directory):
                whole = scene.variant[step.variant] if step.variant else scene.without_variants
                linked = {holder / STAGES[stage].file: stage_fingerprint(step.scene, stage)
                          for stage, holder in step.links.items()}
                in_files(comm, step.directory, partial(link_products, linked, step.directory))
                for stage in step.stages:
                    name = f"{step.variant}: {stage}" if step.variant else stage
                    measure = partial(wall_time_of, stage, step.scene, whole, step.directory, stop)
                    if step.variant not in failed and not measured(name, measure):
                        failed.add(step.variant)
            if "report" in scene.stages_of_all:
                in_files(comm, directory, lambda: write_files({directory / "scene.toml": few.to_toml()}))
                measured("report", lambda: (elapsed(comm, lambda: report.run(directory, comm, stop=stop)), 0.0, 0))
    except Stopped:
        raise Stopped(stop.reason, "starts again from the beginning") from None


def measured(name: str, measure: Callable[[], tuple[float, float, int | None]]) -> bool:
    """Log the wall time, the seconds per step and the number of steps of a stage, as `measure` returns them.

    Returns False if `measure` fails. If HDF5 could not write a file, the error is raised, because the job must then be
    aborted.
    """
    try:
        with quiet():
            seconds, step, number = measure()
    except UserError as error:
        if writing_failed():
            raise
        log.info("%-28s  not measured: %s", name, error)
        return False
    if number is None:
        log.info("%-28s  %8.3g         ?  unknown, because the number of steps is unknown", name, step)
    else:
        log.info("%-28s  %8.3g  %8d  %s", name, step, number, duration(seconds))
    return True


def wall_time_of(stage: str, few: Scene, whole: Scene, directory: Path,
                 stop: StepTimes) -> tuple[float, float, int | None]:
    """Estimate the cost of a stage of the `whole` scene from a run of the short scene `few`.

    Returns the wall time of the stage, the seconds of a step (including storing between steps), and the number of
    steps, None if unknown. A stage without equal steps has 0 steps.
    """
    stop.check()
    comm, first, expected, once = stop.comm, len(stop.times), estimate(whole), few
    if stage == "train" and few.training:  # `rest_of_training` measures its phases
        once = replace(few, training=replace(few.training, steps=1, combined_steps=0, horizons=None, field_weight=0.0,
                                             velocity_kl_weight=0.0, acceleration_kl_weight=0.0))
    seconds = elapsed(comm, lambda: RUN[stage](once, comm, directory, stop))
    if stage == "train":
        if whole.model.path is not None:
            return seconds, 0.0, 0
        definition, device = ModelDefinition.of(few), prepare_torch(whole.device, comm)
        rest, number, step = rest_of_training(definition, few.training, whole.training.frames, directory, device, stop)
        return seconds + rest, step, number
    if stage == "find-step":  # assumes that the short rollouts of this run last one frame interval
        span = expected.rollout.turnover_time * find_step.TURNOVERS if expected.rollout else 0.0
        return seconds * max(round(span / whole.simulation.frame_interval), 1), 0.0, 0 if expected.rollout else None
    paces = [after - before for before, after in zip(stop.times[first:], stop.times[first + 1:])]
    usual, taken = paces[WARM_UP_STEPS:] or paces or [seconds], len(paces) + 1
    step = sum(usual) / len(usual)
    if stage == "dns":
        number = expected.steps
    elif stage == "reconstruct":
        frames = expected.frame_intervals
        number = None if frames is None else math.ceil((frames + 1) / whole.reconstruction.every)
    elif stage == "train-kernel":
        number = 2 * whole.kernel.steps
    else:
        number = expected.rollout and round(taken * expected.rollout.intervals / FEW_STEPS)
    return seconds + max((number or 0) - taken, 0) * step, step, number


def rest_of_training(definition: ModelDefinition, few: Training, frames: int, directory: Path, device: torch.device,
                     stop: StopRequest) -> tuple[float, int, float]:
    """Estimate the work that a training of one step with the settings `few` leaves out: the preparation of further
    frames, up to `frames` in the whole training, and the steps and validations of all phases.

    Returns the wall time of this work, the number of steps, and the mean seconds of a step.
    """
    comm, seconds, stepping, number = stop.comm, 0.0, 0.0, 0
    with open_truths(directory / STAGES["dns"].file, few.truth_files, comm, device) as (_, trained_on):
        data = training_data(definition, few, trained_on)
        parameters = list(data[0].model.parameters())
        each_frame = elapsed(comm, lambda: [each.frames for each in data]) / few.frames
        seconds += each_frame * (frames - few.frames + TESTED_FRAMES)
        for phase in training_phases(data, directory / STAGES["train-kernel"].file):
            stop.check()
            optimizer = Adam(comm, parameters, phase.steps, *phase.rates)
            step = min(elapsed(comm, lambda: phase.take(optimizer, index))
                       for index in range(min(2 * FEW_STEPS, phase.steps)))
            stepping, number = stepping + phase.steps * step, number + phase.steps
            seconds += (phase.steps // phase.validate_every + 1) * elapsed(comm, phase.validate)
    return seconds + stepping, number, stepping / max(number, 1)


def shortened(scene: Scene, turnover: float | None) -> Scene:
    """Return a scene and its variants with few frames and steps, in a flow with this turnover time.

    If `turnover` is None, they have a single frame interval. The number of training steps does not change.
    """
    variants = {name: shortened(variant, turnover) for name, variant in scene.variant.items()}
    few, tracers, simulation, training = scene.without_variants, scene.tracers, scene.simulation, scene.training
    if tracers is None:
        step = estimate(scene).step or few.time.max_step
        return replace(few, time=replace(few.time, duration=2 * FEW_STEPS * step))
    changed: dict[str, Any] = {}
    if scene.spin_up:
        changed["spin_up"] = replace(scene.spin_up, turnovers=LEAST_TURNOVERS, stationary=None)
    if scene.kernel:
        changed["kernel"] = replace(scene.kernel, steps=FEW_STEPS)
    longest = between = 0        # in frames: the longest horizon, and the frame interval of the rollout
    if training:
        longest = max(training.horizons.frames) if training.horizons else 0
        frames = min(training.frames, 2 * max(len(training.truths or ()), 1))
        changed["training"] = replace(training, window=1.0, frames=frames)
    if simulation:
        between = round(simulation.frame_interval / tracers.frame_interval)
        turnovers = (FEW_STEPS - 0.5) * simulation.frame_interval / turnover if turnover else simulation.turnovers
        changed["simulation"] = replace(simulation, turnovers=turnovers, start=0.0)
    span = (FEW_STEPS + max(2 * longest, between) - 0.5) * tracers.frame_interval
    changed["tracers"] = replace(tracers, turnovers=span / turnover if turnover else LEAST_TURNOVERS, field_every=1)
    return replace(few, variant=variants, **changed)


@contextmanager
def temporary_directory(comm: Comm) -> Iterator[Path]:
    """Make a directory below the working directory for all ranks, and remove it at the end of the block. Collective."""
    path = Path(in_files(comm, Path(), lambda: tempfile.mkdtemp(prefix="eddies-check-", dir=".")))
    try:
        yield path
        comm.Barrier()
    finally:  # also after an error of this rank alone, so without a barrier
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def quiet() -> Iterator[None]:
    """Suppress the log lines of the stages."""
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def elapsed(comm: Comm, work: Callable[[], object]) -> float:
    """Call `work` on all ranks, and return the wall seconds until all ranks have finished."""
    comm.Barrier()
    began = time.perf_counter()
    work()
    comm.Barrier()
    return time.perf_counter() - began
