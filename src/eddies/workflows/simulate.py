"""Rollout: particles start at a frame of the ground truth, and the trained model or a baseline moves them.

`Course` is the loop over steps and frames, with its checkpoints.
"""

import logging
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.clock import ROUND_OFF, Clock, ProgressLine, pace_in_words, rounded_up
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.frame_segments import FrameLayout, FrameSegments, TrajectoryLayout
from eddies.io.hdf5 import Table, create_product, write_table
from eddies.io.new_files import set_attributes
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder, wrap
from eddies.parallel.reduction import global_sum
from eddies.parallel.step_times import StepTimes
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.particles.particle_set import as_numpy
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows import measure
from eddies.workflows.ground_truth.frame_counts import rollout_start
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.rollout.method import Method, TimeStep, forcing_of, make_method
from eddies.workflows.run_directory.fingerprints import stage_provenance
from eddies.workflows.run_directory.work import read_found_step, step_path

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Run the rollout of a scene, write rollout.h5, and measure the rollout.

    If the state becomes faulty, the rollout ends. The product then holds the frames so far, and its status describes
    the fault. A stopped rollout continues from its newest checkpoint.
    """
    directory, settings, device = Path(directory), scene.simulation, prepare_torch(scene.device, comm)
    provenance = stage_provenance(scene, "simulate")
    guard = Guard(comm, directory / STAGES["simulate"].checkpoints, provenance["fingerprint"], stop,
                  " of the rollout")
    with open_truth(comm, directory / STAGES["dns"].file, device) as truth, torch.no_grad():
        start = rollout_start(settings, scene.tracers, scene.seen_in(directory), len(truth.times), truth.field_frames)
        step = None
        if (path := step_path(settings, directory)) is not None:
            found, _ = read_found_step(path, comm)
            step = TimeStep(found["integrator"], found["size"])
        method = make_method(scene, step, truth, start, directory)
        saved = guard.checkpoints.newest()
        layout = frame_layout(truth.total, truth.decomposition.length, method.has_density)
        segments = FrameSegments(comm, guard.checkpoints.path, layout, () if saved is None else saved.files)
        turnover = truth.reference["eddy_turnover_time"]
        count = rounded_up(settings.turnovers * turnover / settings.frame_interval)
        forcing = forcing_of(settings.injection, scene.forcing, truth)
        with segments:
            course = Course(method, segments, count, settings.frame_interval, guard, saved)
            outcome = course.run()
            with create_product(comm, directory / STAGES["simulate"].file, "rollout", provenance) as file:
                segments.assemble(file)
                set_attributes(file.create_group("rollout"), {
                    **outcome, **method.description(), "method": settings.method,
                    "turnovers": outcome["time"] / turnover,
                    "injection_rate": forcing.injection_rate if forcing else 0.0,
                    "truth_injection_rate": truth.forcing.injection_rate if truth.forcing else 0.0,
                    "eddy_turnover_time": turnover, "start_time": float(truth.times[start]),
                    "particles": truth.total, "ranks": comm.size})
                for name, columns in method.series().items():
                    write_table(file, name, Table({"time": course.times, **columns}, "time", {"time": "T"}))
    guard.checkpoints.remove()
    measure.run(directory, comm)
    pace = (pace_in_words(outcome["seconds_per_step"], outcome["storing_share"]) if "seconds_per_step" in outcome
            else "too few steps to time")
    log.info("rollout: %.2f turnovers, %s; %s", outcome["time"] / turnover, pace, outcome["status"])


def frame_layout(total: int, length: float, density: bool) -> FrameLayout:
    """Return the layout of the frames of a rollout with `total` particles in a box of edge `length`."""
    columns = {"position": (3,), "velocity": (3,), "acceleration": (3,)} | ({"density": ()} if density else {})
    return FrameLayout(length, {"model": TrajectoryLayout(total, columns)}, np.float32, {})


class Course:
    """Runs a method through `count` frame intervals of the length `interval`, from the start or from a checkpoint.

    Frames are written into `segments`. `guard` is called before each step and writes checkpoints. There are no
    checkpoints if the method has no `state_dict`.
    """

    def __init__(self, method: Method, segments: FrameSegments, count: int, interval: float, guard: Guard,
                 saved: Checkpoint | None) -> None:
        self.method, self.segments, self.count, self.interval, self.guard = method, segments, count, interval, guard
        self.comm, self.times = segments.comm, []
        self.clock, self.timed, self.energy = Clock(count * interval), StepTimes(), 0.0
        if saved is not None:
            self._load(saved)
            method.load_state_dict(saved)
            log.info("rollout: continues from step %d, time %.4g", self.steps, self.clock.time)
        self.progress = ProgressLine("rollout", self._describe, done=self._done)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return self.clock.steps

    @property
    def _done(self) -> float:
        return min(self.clock.elapsed / self.clock.span, 1.0)

    def run(self) -> dict[str, float | str]:
        """Advance to the last frame, or until the state is faulty.

        Returns attributes of the product: `status`, the `time` of the last frame, and the number of `steps`. If a step
        was taken, there are also the mean `time_step`, and `storing_share`, the share of the wall time that storing
        took. If a step was timed, the numbers of `StepTimes` are added.
        """
        complaint: str | None = None
        if not self.times:
            self._store(0.0)
        while complaint is None and (number := len(self.times)) <= self.count:
            until = number * self.interval
            while complaint is None and self.method.time < until - ROUND_OFF * self.interval:
                if hasattr(self.method, "state_dict"):
                    self.guard(self, self.segments)
                else:
                    self.guard.stop.check()
                complaint = self._step(until)
                self.progress(self._done, self.steps)
            if complaint is None:
                self._store(until)
        if complaint is not None and self.comm.rank == 0:
            log.warning("rollout stopped at time %.4g: %s", self.clock.time, complaint)
        step = {"time_step": self.clock.time / self.steps,
                "storing_share": self.progress.storing_share} if self.steps else {}
        return {"status": "complete" if complaint is None else f"stopped: {complaint}", "time": self.times[-1],
                "steps": self.steps, **step, **self.timed.numbers(self.comm)}

    def state_dict(self) -> dict[str, Any]:
        """Return the state for a checkpoint, without the frames, which have files of their own."""
        return {"rollout": {"clock": self.clock.state_dict(), "energy": self.energy, "ranks": self.comm.size,
                            "timed": self.timed.rows, "times": self.times},
                **self.method.state_dict()}

    def _load(self, saved: Checkpoint) -> None:
        """Restore all but the state of the method."""
        state = saved["rollout"]
        self.clock.load_state_dict(state["clock"])
        self.times, self.energy = state["times"], state["energy"]
        if state["ranks"] == self.comm.size:  # wall times on another number of ranks differ
            self.timed.rows = state["timed"]

    def _step(self, until: float) -> str | None:
        before = self.method.time
        self.timed.begin()
        complaint = self.method.advance(until, self.steps + 1)
        if complaint is None:
            self.clock.tick(self.method.time - before)
            self.timed.end()
        return complaint

    def _store(self, at: float) -> None:
        """Store the frame at the time `at`, and keep the kinetic energy of its particles for the progress line."""
        layout, own = self.segments.layout, self.segments.layout.trajectories["model"]
        # The first step uses the forces of the first frame. Later frames evaluate forces for storing only; this time
        # counts as storing.
        with self.progress.storing() if self.times else nullcontext():
            particles, acceleration = self.method.frame(at)
        with self.progress.storing():
            columns = {**particles.to_numpy(), "acceleration": as_numpy(acceleration)}
            columns["position"] = wrap(columns["position"], layout.length)
            order = IdOrder(self.comm, columns["id"], own.total)
            self.segments.open(self.steps)
            self.segments.trajectories["model"].append(self.steps, at, order.start, {
                name: order.apply(columns[name]) for name in own.columns})
            self.times.append(at)
        velocity = particles.velocity.double()
        first, second = velocity.sum(0), velocity.square().sum(0)
        mean, square = global_sum(self.comm, as_numpy(torch.stack([first, second]))) / own.total
        self.energy = float(np.sum(square - mean**2)) / 2  # without the mean velocity

    def _describe(self) -> str:
        return f"t {self.clock.time:.4g}  energy {self.energy:.4g}{self.method.status()}"
