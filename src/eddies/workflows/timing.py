"""`eddies check --time`: a few real steps of each stage, in a directory that is removed, and the wall time of the stage
that follows. The stages work with a small ground truth of the scene's own flow, on its own grid."""

from __future__ import annotations

import logging
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from eddies.clock import WARM_UP_STEPS, duration
from eddies.errors import UserError
from eddies.io.hdf5 import in_files
from eddies.io.provenance import product_attributes
from eddies.io.whole_files import write_files
from eddies.learning.optimization import Adam
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import Stopped, StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows import dns, find_step, report, simulate, train, train_kernel
from eddies.workflows.foreseen.numbers import expected_step, flow_steps, rollout_of
from eddies.workflows.foreseen.storage import training_steps
from eddies.workflows.ground_truth.frame_counts import TESTED_FRAMES
from eddies.workflows.learned.model import load_kernel
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.training_data import training_data
from eddies.workflows.learned.training_phases import horizon_phases, one_step_phases
from eddies.workflows.learned.truths import open_truths

log = logging.getLogger("eddies")

RUN = {"dns": dns.run, "train-kernel": train_kernel.run, "train": train.run, "find-step": find_step.run,
       "simulate": simulate.run,        "report": report.run_stage}
FEW = 4                      # steps of a training, and intervals of a rollout
A_MOMENT = 1e-9              # turnovers of a spin-up of as few steps as there can be


class StepTimes(StopRequest):
    """Is asked before every step of a stage whether the job is to end, and notes when."""

    def __init__(self, comm: Comm, signals: Sequence[int]) -> None:
        super().__init__(comm, signals)
        self.times: list[float] = []

    def __call__(self) -> bool:
        self.times.append(time.perf_counter())
        return super().__call__()


def run(scene: Scene, comm: Comm, signals: Sequence[int] = ()) -> None:
    """Log seconds a step, number of steps and wall time of each stage; all ranks call it. Raises Stopped after a
    signal."""
    rollout, stop = rollout_of(scene), StepTimes(comm, signals)
    whole = {"dns": flow_steps(scene), "train-kernel": scene.kernel and 2 * scene.kernel.steps,
             "train": training_steps(scene) if scene.model else 0, "find-step": 0,
             "simulate": rollout and rollout.steps, "report": 0}
    log.info("%s: measured on %d %s", scene.name, comm.size, "rank" if comm.size == 1 else "ranks")
    log.info("stage         s a step   steps  wall time")
    with temporary_directory(comm) as directory:
        for stage in scene.stages:
            try:
                with quiet():
                    seconds, step = measured(stage, whole[stage], scene, comm, directory, stop)
            except Stopped:
                raise Stopped(stop.reason, "from the beginning") from None
            except UserError as error:
                log.info("%-12s  not measured: %s", stage, error)
                continue
            known = whole[stage] is not None
            log.info("%-12s  %8.3g  %6s  %s", stage, step, whole[stage] if known else "?",
                     duration(seconds) if known else "not known, as the number of steps is not")


def measured(stage: str, steps: int | None, scene: Scene, comm: Comm, directory: Path,
             stop: StepTimes) -> tuple[float, float]:
    """Wall time of a stage of so many steps, or of an unknown number (None), and of one of them with what is stored
    between steps, from a short run."""
    turnover = None
    if scene.tracers:
        if stage == "dns":  # once through a single interval of frames, to know how fast the flow turns over
            dns.run(shortened(scene, None), comm, directory, stop)
        turnover = product_attributes(directory / STAGES["dns"].file, "reference")["eddy_turnover_time"]
    few = shortened(scene, turnover)
    once = few
    if stage == "train" and few.training:
        once = replace(few, training=replace(few.training, steps=1, combined_steps=0, horizons=None, field_weight=0.0,
                                             velocity_kl_weight=0.0, acceleration_kl_weight=0.0))
    in_files(comm, directory, lambda: write_files({directory / "scene.toml": few.to_toml()}))  # for the report
    stop.check()
    first = len(stop.times)
    seconds = wall_time(comm, lambda: RUN[stage](once, comm, directory, stop))
    if stage == "train":
        rest, step = rest_of_training(few, scene, comm, directory, stop)
        return seconds + rest, step
    if steps == 0:  # it asks now and then, and not before each step
        return seconds, 0.0
    paces = [after - before for before, after in zip(stop.times[first:], stop.times[first + 1:])]
    usual = paces[WARM_UP_STEPS:] or paces
    step = sum(usual) / max(len(usual), 1)
    return seconds + max((steps or 0) - len(paces) - 1, 0) * step, step


def rest_of_training(few: Scene, scene: Scene, comm: Comm, directory: Path, stop: StopRequest) -> tuple[float, float]:
    """Seconds that the training of the model takes beside a run with one step and `few` frames, from some frames, steps
    and validations of each phase; and the mean of its steps."""
    if scene.model.path is not None:
        return 0.0, 0.0
    with open_truths(directory / STAGES["dns"].file, few.training.truth_files, few.tracers, comm,
                     prepare_torch(scene.device, comm)) as (_, trained_on):
        kernel = load_kernel(comm, directory / STAGES["train-kernel"].file) if few.training.field_weight > 0 else None
        data = training_data(ModelDefinition.of(few), few.training, trained_on)
        parameters = list(data[0].model.parameters())
        frames = wall_time(comm, lambda: [each.frames for each in data]) / few.training.frames
        seconds, stepping = frames * (scene.training.frames - few.training.frames + TESTED_FRAMES), 0.0
        for phase in [*one_step_phases(data, kernel), *horizon_phases(data)] if parameters else ():
            stop.check()
            optimizer = Adam(comm, parameters, phase.steps, *phase.rates)
            steps = [wall_time(comm, lambda: phase.take(optimizer, number))
                     for number in range(min(2 * FEW, phase.steps))]
            stepping += phase.steps * min(steps)
            first = sum(steps) - len(steps) * min(steps)  # of a frame, which makes its lists when it is first drawn
            seconds += first / few.training.frames * scene.training.frames
            seconds += (phase.steps // phase.validate_every + 1) * wall_time(comm, phase.validate)
    return seconds + stepping, stepping / max(training_steps(scene), 1)


def shortened(scene: Scene, turnover: float | None) -> Scene:
    """The scene with as few steps and frames as all of its stages can do with, in a flow of that turnover time; with
    one interval of frames where it is not known. Of a training the number of steps stays."""
    few, tracers, simulation, training = scene.without_variants, scene.tracers, scene.simulation, scene.training
    if tracers is None:
        step = expected_step(scene)
        return replace(few, time=replace(few.time, duration=2 * FEW * (step[0] if step else few.time.max_step)))
    changed: dict[str, Any] = {}
    if scene.spin_up:
        changed["spin_up"] = replace(scene.spin_up, turnovers=A_MOMENT, stationary=None)
    if scene.kernel:
        changed["kernel"] = replace(scene.kernel, steps=FEW)
    longest = between = 0        # every horizon, with one held out, and an interval of the rollout must fit
    if training:
        longest = max(training.horizons.frames) if training.horizons else 0
        frames = min(training.frames, 2 * max(len(training.truths or ()), 1))
        changed["training"] = replace(training, window=1.0, frames=frames)
    if simulation:
        between = round(simulation.frame_interval / tracers.frame_interval)
        turnovers = (FEW - 0.5) * simulation.frame_interval / turnover if turnover else simulation.turnovers
        changed["simulation"] = replace(simulation, turnovers=turnovers, start=0.0)
    span = (FEW + max(2 * longest, between) - 0.5) * tracers.frame_interval
    changed["tracers"] = replace(tracers, turnovers=span / turnover if turnover else A_MOMENT, field_every=1)
    return replace(few, **changed)


@contextmanager
def temporary_directory(comm: Comm) -> Iterator[Path]:
    """A directory below the working directory, which all ranks see, for as long as the block lasts; removed however it
    ends."""
    path = Path(in_files(comm, Path(), lambda: tempfile.mkdtemp(prefix="eddies-check-", dir=".")))
    try:
        yield path
        comm.Barrier()
    finally:  # perhaps after an error of this rank alone: nobody is waited for
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def quiet() -> Iterator[None]:
    """No lines of the stages meanwhile."""
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


def wall_time(comm: Comm, work: Callable[[], object]) -> float:
    """Seconds in which all ranks do some work."""
    comm.Barrier()
    began = time.perf_counter()
    work()
    comm.Barrier()
    return time.perf_counter() - began
