"""Simulated time, the ladder of step sizes, how often something is due, and the progress line."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Callable

log = logging.getLogger("eddies")

YEAR = 365.25 * 86400.0  # seconds
YEARS = 10  # from which on nobody wants to know the minutes


class Clock:
    """Counts steps and simulated time, up to `end` or until it is stopped."""

    def __init__(self, end: float = math.inf, time: float = 0.0) -> None:
        self.end, self.time, self.steps = end, time, 0

    @property
    def remaining(self) -> float:
        """Time left; a remainder that is only round-off of the sum of steps counts as none."""
        left = self.end - self.time
        return left if left > 1e-9 * max(self.time, 1.0) else 0.0

    @property
    def running(self) -> bool:
        """Whether time is left."""
        return self.remaining > 0

    def stop(self) -> None:
        """End here."""
        self.end = self.time

    def state_dict(self) -> dict[str, float]:
        """All that a clock knows, for a checkpoint."""
        return {"time": self.time, "steps": self.steps, "end": self.end}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Inverse of `state_dict`."""
        self.time, self.steps, self.end = state["time"], int(state["steps"]), state["end"]

    def tick(self, step: float) -> None:
        """Advance by one step."""
        self.steps += 1
        self.time += step


def ladder_step(largest: float, bound: float) -> float:
    """The largest of largest * 2^-m, m = 0, 1, ..., that does not exceed `bound`."""
    if not bound > 0:
        raise ValueError(f"time step bound {bound} is not positive: the flow is no longer finite")
    return largest if bound >= largest else largest * 2.0 ** -math.ceil(math.log2(largest / bound))


class ProgressLine:
    """Logs one line every few seconds of wall time: how far, and how long it will still take. It is to be called after
    every step, so that lines come by time and not by frames.

    `describe` returns what is worth reading of the state at that moment; it is called where that is logged only, so it
    must not communicate. `done` and `step` are those of the checkpoint that a stage goes on from: what was done before
    is no measure of what is left.
    """

    def __init__(self, stage: str, describe: Callable[[], str], interval: float = 5.0, done: float = 0.0,
                 step: int = 0) -> None:
        self.stage, self.describe, self.interval, self.done, self.step = stage, describe, interval, done, step
        self._started = self._last = time.perf_counter()

    def __call__(self, done: float, step: int) -> None:
        """Report if it is time; `done` is the finished fraction of the stage in [0, 1], `step` the steps so far."""
        if not log.isEnabledFor(logging.INFO):
            return
        now = time.perf_counter()
        if now - self._last < self.interval or done <= self.done:
            return
        self._last = now
        elapsed = now - self._started
        log.info("%s  step %d  %s  %.3f s/step  %.0f %%  %s left", self.stage, step, self.describe(),
                 elapsed / max(step - self.step, 1), 100 * done, duration(elapsed * (1 - done) / (done - self.done)))


def duration(seconds: float) -> str:
    """Seconds in words a person reads: 42 s, 3 min 20 s, 2 h 05 min, 1.2e+30 years."""
    if seconds >= YEARS * YEAR:
        return f"{seconds / YEAR:.2g} years"
    seconds = max(int(round(seconds)), 0)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
