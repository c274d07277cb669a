"""Rollout: particles from a moment of the ground truth on, moved by the trained model or by a baseline."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from eddies.clock import Clock, ProgressLine
from eddies.io.hdf5 import create_product, open_product, write_attributes, write_table
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.particle_set import ParticleSet
from eddies.scene.methods import method_class
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.kernel import load_kernel
from eddies.workflows.rollout.frames import RolloutFrames
from eddies.workflows.rollout.particle_run import injection_rate

log = logging.getLogger("eddies")

# The first steps plan, compile and fill caches: they are no measure of the others.
WARM_UP_STEPS = 2


class Method(Protocol):
    """What moves the particles of a rollout, made as Class(scene, truth, start, directory, device) where `start` is the
    frame of the ground truth that it starts from. All methods are collective."""

    has_density: bool  # of the particles of its frames

    time: float  # of its particles, since the start

    def advance(self, until: float, number: int) -> str | None:
        """Take a step, the `number`-th of the run, that ends at a time or before it, or beyond it where `frame` can
        look back; what is wrong with the state after it, on all ranks, or None."""

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """The particles at a time that the last step reached, in any order, and their acceleration (n, 3)."""

    def status(self) -> str:
        """What the progress line shows of it beside time and energy."""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Tables for the product, with a value in each column for each call of `frame`."""

    def description(self) -> dict[str, float | str]:
        """The settings of what moves the particles, for the attributes of the product."""


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Simulate what a scene asks for and write rollout.h5. A run that goes wrong ends there, keeps its frames, and
    says so in its status."""
    device = prepare_torch(scene.device, comm)
    directory, settings = Path(directory), scene.simulation
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)
    with (open_product(comm, directory / "ground_truth.h5", "ground_truth") as truth_file,
          create_product(comm, directory / "rollout.h5", "rollout", scene.provenance("simulate")) as file):
        truth = GroundTruth(truth_file, slab)
        start = start_frame(scene, truth)
        method = method_class(settings.method)(scene, truth, start, directory, device)
        kernel = load_kernel(comm, directory / "kernel.h5") if scene.kernel else None
        frames = RolloutFrames(file, truth, kernel, truth.times[start], method.has_density)
        turnover = truth.reference["eddy_turnover_time"]
        count = int(np.ceil(settings.turnovers * turnover / settings.frame_interval - 1e-9))
        with torch.no_grad():
            outcome = roll_out(method, frames, count, settings.frame_interval, truth, stop or StopRequest(comm))
        write_attributes(file.create_group("rollout"), {
            **outcome, **method.description(), "method": settings.method, "turnovers": outcome["time"] / turnover,
            "injection_rate": injection_rate(scene, truth), "eddy_turnover_time": turnover,
            "start_time": float(truth.times[start]), "particles": truth.total, "ranks": comm.size})
        for name, columns in method.series().items():
            write_table(file, name, {"time": frames.times, **columns})
    log.info("rollout: %s after %.2f turnovers, %.3f s/step", outcome["status"], outcome["time"] / turnover,
             outcome["seconds_per_step"])


def roll_out(method: Method, frames: RolloutFrames, count: int, interval: float, truth: GroundTruth,
             stop: StopRequest) -> dict[str, float | str]:
    """Advance `count` frame intervals, or until the state is at fault; returns status, time, and seconds a step."""
    comm = truth.decomposition.comm
    clock, seconds, complaint = Clock(end=count * interval), [], None
    progress = ProgressLine("rollout", lambda: f"t {clock.time:.3f}  energy {energy:.4f}{method.status()}")
    energy = store(frames, method, clock, 0.0, truth)
    for number in range(1, count + 1):
        until = number * interval
        while complaint is None and method.time < until - 1e-9 * interval:
            stop.check()
            began, before = time.perf_counter(), method.time
            complaint = method.advance(until, clock.steps + 1)
            if complaint is None:
                clock.tick(method.time - before)
                seconds.append(time.perf_counter() - began)
                progress(min(clock.time / clock.end, 1.0), clock.steps)
        if complaint is not None:
            break
        energy = store(frames, method, clock, until, truth)
    if complaint is not None and comm.rank == 0:
        log.warning("rollout stopped at time %.4g: %s", clock.time, complaint)
    step = clock.time / clock.steps if clock.steps else np.nan
    return {"status": "complete" if complaint is None else f"stopped: {complaint}", "time": frames.times[-1],
            "steps": clock.steps, "time_step": step, **quartiles(seconds)}


def quartiles(seconds: Sequence[float]) -> dict[str, float]:
    """Median and quartiles of the seconds of steps, those of the warm-up left out; NaN without others."""
    low, median, high = np.quantile(seconds[WARM_UP_STEPS:] or [np.nan], (0.25, 0.5, 0.75))
    return {"seconds_per_step": median, "seconds_per_step_low": low, "seconds_per_step_high": high}


def store(frames: RolloutFrames, method: Method, clock: Clock, time: float, truth: GroundTruth) -> float:
    """Store the frame of a time; returns the mean kinetic energy <v.v>/2 of its particles."""
    particles, acceleration = method.frame(time)
    frames.store(clock.steps, time, particles, acceleration)
    energy = 0.5 * float(particles.velocity.double().square().sum())
    return float(global_sum(truth.decomposition.comm, energy)) / truth.total


def start_frame(scene: Scene, truth: GroundTruth) -> int:
    """The first frame with a filtered field at or after the moment that the scene asks for.

    Raises SceneError if none follows that leaves a frame of the ground truth to compare with.
    """
    fraction = scene.simulation.start
    wanted = truth.last_frame_seen(scene.seen) if fraction is None else int(fraction * (len(truth.times) - 1))
    at_fields = [truth.frame_of_field(index) for index in range(len(truth.fields.times))]
    last = len(truth.times) - 2 - round(scene.simulation.frame_interval / scene.tracers.frame_interval)
    usable = [frame for frame in at_fields if max(wanted, 1) <= frame <= last]
    if not usable:
        raise SceneError(f"[simulation] start: after frame {wanted} of {len(truth.times)} no filtered field is "
                         "followed by ground truth to compare with; lower start or [training] window, or raise "
                         "[tracers] turnovers")
    return usable[0]
