"""The course of a rollout: steps and frames, and what a checkpoint must hold of them."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any

import numpy as np

from eddies.clock import WARM_UP_STEPS, Clock, ProgressLine
from eddies.io.checkpoint import Checkpoint, Guard
from eddies.io.frame_segments import FrameLayout, FrameSegments
from eddies.parallel.migration import IdOrder, wrap
from eddies.parallel.reduction import global_sum
from eddies.particles.particle_set import as_numpy
from eddies.workflows.rollout.method import Method

log = logging.getLogger("eddies")


def frame_layout(total: int, length: float, density: bool) -> FrameLayout:
    """What a rollout stores of so many particles in a box: with their `density`, where they have one."""
    columns = {"position": (3,), "velocity": (3,), "acceleration": (3,)} | ({"density": ()} if density else {})
    return FrameLayout(total, length, {"model": columns}, np.float32, {})


class Course:
    """A method on its way through `count` frame intervals of a length, from the start or from a checkpoint.

    `segments` take the frames. `guard` looks on before each step. A method that cannot tell its state makes no
    checkpoints.
    """

    def __init__(self, method: Method, segments: FrameSegments, count: int, interval: float, guard: Guard,
                 saved: Checkpoint | None) -> None:
        self.method, self.segments, self.count, self.interval, self.guard = method, segments, count, interval, guard
        self.comm, self.times = segments.comm, []
        self.clock, self.seconds, self.energy = Clock(end=count * interval), [], 0.0
        self._warm_up = WARM_UP_STEPS
        if saved is not None:
            self._load(saved)
            method.load_state_dict(saved)
            log.info("rollout: goes on from step %d, time %.4g", self.steps, self.clock.time)
        self.progress = ProgressLine("rollout", self._describe, done=self.clock.time / self.clock.end)

    @property
    def steps(self) -> int:
        """Steps taken so far."""
        return self.clock.steps

    def run(self) -> dict[str, float | str]:
        """Advance to the last frame, or until the state is at fault.

        Returns status, time, steps and, where there are any, their mean length, the share of the wall time since the
        start or the last restart that storing frames took, and the seconds of those steps that were timed.
        """
        complaint: str | None = None
        if not self.times:
            self._store(0.0)
        while complaint is None and (number := len(self.times)) <= self.count:
            until = number * self.interval
            while complaint is None and self.method.time < until - 1e-9 * self.interval:
                self._look()
                complaint = self._step(until)
                self.progress(min(self.clock.time / self.clock.end, 1.0), self.steps)
            if complaint is None:
                self._store(until)
        if complaint is not None and self.comm.rank == 0:
            log.warning("rollout stopped at time %.4g: %s", self.clock.time, complaint)
        step = {"time_step": self.clock.time / self.steps,
                "storing_share": self.progress.storing_share} if self.steps else {}
        return {"status": "complete" if complaint is None else f"stopped: {complaint}", "time": self.times[-1],
                "steps": self.steps, **step, **quartiles(self.seconds)}

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, for a checkpoint, beside the files of the frames."""
        return {"rollout": {"clock": self.clock.state_dict(), "energy": self.energy, "ranks": self.comm.size,
                            "seconds": self.seconds, "times": self.times},
                **self.method.state_dict()}

    def _load(self, saved: Checkpoint) -> None:
        """Take what is no part of the method from a checkpoint."""
        known = saved["rollout"]
        self.clock.load_state_dict(known["clock"])
        self.times, self.energy = known["times"], known["energy"]
        if known["ranks"] == self.comm.size:  # else they are no measure of the steps of this run
            self.seconds = known["seconds"]

    def _look(self) -> None:
        """Let the guard look on; without a state to keep, only whether the run is to stop."""
        if hasattr(self.method, "state_dict"):
            self.guard(self, self.segments)
        else:
            self.guard.stop.check()

    def _step(self, until: float) -> str | None:
        began, before = time.perf_counter(), self.method.time
        complaint = self.method.advance(until, self.steps + 1)
        if complaint is None:
            self.clock.tick(self.method.time - before)
            self._warm_up -= 1
            if self._warm_up < 0:
                self.seconds.append(time.perf_counter() - began)
        return complaint

    def _store(self, at: float) -> None:
        """Store the frame of a time, and take down the mean kinetic energy <v.v>/2 of its particles."""
        layout = self.segments.layout
        # The first step begins with the forces of the first frame; what others take is taken for the frame alone.
        with self.progress.storing() if self.times else nullcontext():
            particles, acceleration = self.method.frame(at)
        with self.progress.storing():
            columns = {**particles.to_numpy(), "acceleration": as_numpy(acceleration)}
            columns["position"] = wrap(columns["position"], layout.length)
            order = IdOrder(self.comm, columns["id"], layout.total)
            self.segments.open(self.steps)
            self.segments.trajectories["model"].append(self.steps, at, order.start, {
                name: order.apply(columns[name]) for name in layout.trajectories["model"]})
            self.times.append(at)
        energy = 0.5 * float(particles.velocity.double().square().sum())
        self.energy = float(global_sum(self.comm, energy)) / layout.total

    def _describe(self) -> str:
        return f"t {self.clock.time:.3f}  energy {self.energy:.4f}{self.method.status()}"


def quartiles(seconds: Sequence[float]) -> dict[str, float]:
    """Median and quartiles of the seconds of steps; nothing without any."""
    if not seconds:
        return {}
    low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75))
    return {"seconds_per_step": median, "seconds_per_step_low": low, "seconds_per_step_high": high}
