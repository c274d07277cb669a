"""Simulated time, the ladder of step sizes (each half the previous one), and the progress line.

No unit of time is special, so round-off is compared with a duration or with an interval between times.
"""

import logging
import math
import statistics
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager

log = logging.getLogger("eddies")

ROUND_OFF = 1e-9             # fraction of a duration that the round-off of a sum of steps does not reach
SAME = 1e-3                  # fraction of an interval below which two times are the same
YEAR = 365.25 * 86400.0      # seconds
YEARS = 10                   # longer durations are given in years
WARM_UP_STEPS = 2            # first steps, which plan, compile and fill caches; the median leaves them out
RECENT = 1000                # number of latest steps whose median the progress line gives
INTERVAL = 5.0               # wall seconds between two progress lines


def rounded_up(ratio: float) -> int:
    """Round up to a whole number, but ignore an excess of the order of round-off."""
    return math.ceil(ratio - ROUND_OFF)


class Clock:
    """Counts steps and simulated time, up to the end of a span or until it is stopped.

    A span begins at the time `began`. Steps are added to `elapsed`, the time since then. So the round-off of a long
    time before does not reach a short span.
    """

    def __init__(self, span: float = math.inf) -> None:
        self.began, self.elapsed, self.span, self.steps = 0.0, 0.0, span, 0

    @property
    def time(self) -> float:
        """Simulated time."""
        return self.began + self.elapsed

    @property
    def remaining(self) -> float:
        """Simulated time that remains in the span; 0 if no more is left than the round-off of the sum of its steps."""
        return self.span - self.elapsed if self.elapsed < self.span * (1 - ROUND_OFF) else 0.0

    @property
    def running(self) -> bool:
        """Whether time remains."""
        return self.remaining > 0

    def begin(self, span: float = math.inf) -> None:
        """Begin a span at the present time."""
        self.began, self.elapsed, self.span = self.time, 0.0, span

    def stop(self) -> None:
        """End the span at the present time."""
        self.span = self.elapsed

    def state_dict(self) -> dict[str, float]:
        """Return the state of the clock, for a checkpoint."""
        return {"began": self.began, "elapsed": self.elapsed, "span": self.span, "steps": self.steps}

    def load_state_dict(self, state: dict[str, float]) -> None:
        """Restore a state that `state_dict` has returned."""
        self.began, self.elapsed, self.span = state["began"], state["elapsed"], state["span"]
        self.steps = int(state["steps"])

    def tick(self, step: float) -> None:
        """Advance by one step of size `step`."""
        self.steps += 1
        self.elapsed += step


def ladder_step(largest: float, bound: float) -> float:
    """Return the largest step of the ladder `largest` * 2^-m, m = 0, 1, ..., that does not exceed `bound`.

    Raises ValueError if `bound` is not positive.
    """
    if not bound > 0:
        raise ValueError(f"time step bound {bound} is not positive: the flow is no longer finite")
    return largest if bound >= largest else largest * 2.0 ** -math.ceil(math.log2(largest / bound))


class ProgressLine:
    """Logs progress and remaining time every few seconds of wall time, or after every step with --verbose.

    Call it after every step. The line gives the median of the seconds per step, without the first two steps and without
    the time spent in the context `storing`. It also gives the share of this time in the wall time.

    Parameters
    ----------
    stage : first word of the line.
    describe : returns the state of the stage as text. It must not communicate, because only ranks that log call it.
    done : fraction of the stage that an earlier job has done; the estimate of the remaining time leaves it out.
    unit : name of what is counted, such as "step" or "frame".
    """

    def __init__(self, stage: str, describe: Callable[[], str], done: float = 0.0, unit: str = "step") -> None:
        self.stage, self.describe, self.done, self.unit = stage, describe, done, unit
        self._started = self._last = self._before = time.perf_counter()
        self._seconds: deque[float] = deque(maxlen=RECENT)
        self._taken, self._stored, self._aside = 0, 0.0, 0.0

    @contextmanager
    def storing(self) -> Iterator[None]:
        """Context whose time counts as storing, not as part of a step."""
        began = time.perf_counter()
        yield
        seconds = time.perf_counter() - began
        self._aside += seconds
        self._stored += seconds
        log.debug("%s  stored a frame in %.3f s", self.stage, seconds)

    @property
    def storing_share(self) -> float:
        """Share of the wall time so far that storing took."""
        return self._stored / max(time.perf_counter() - self._started, 1e-9)

    def __call__(self, done: float, step: int) -> None:
        """Log a line if it is due; `done` is the finished fraction of the stage, `step` the number of steps so far."""
        if not log.isEnabledFor(logging.INFO):
            return
        now = time.perf_counter()
        self._taken += 1
        if self._taken == WARM_UP_STEPS + 1:
            self._seconds.clear()
        self._seconds.append(now - self._before - self._aside)
        self._before, self._aside = now, 0.0
        interval = 0.0 if log.isEnabledFor(logging.DEBUG) else INTERVAL
        if now - self._last < interval or done <= self.done:
            return
        self._last = now
        left = (now - self._started) * (1 - done) / (done - self.done)
        pace = pace_in_words(statistics.median(self._seconds), self.storing_share, self.unit)
        log.info("%s  %s %d  %s  %s  %.0f %%  %s left", self.stage, self.unit, step, self.describe(), pace, 100 * done,
                 duration(left))

    def renew(self) -> None:
        """Forget the seconds of earlier steps, because the following steps are of another kind."""
        self._seconds.clear()
        self._taken = 0


def pace_in_words(seconds: float, storing: float, unit: str = "step") -> str:
    """Return the seconds per step as text, such as "0.430 s/step (storing: 46 % of the time)".

    `storing` is the share of the wall time that is spent on storing, 0 to 1.
    """
    return f"{seconds:.3f} s/{unit}" + (f" (storing: {100 * storing:.0f} % of the time)" if storing > 0 else "")


def duration(seconds: float) -> str:
    """Return a number of seconds as text, such as "42 s", "3 min 20 s", "2 h 05 min" or "1.2e+30 years"."""
    if seconds >= YEARS * YEAR:
        return f"{seconds / YEAR:.2g} years"
    seconds = max(int(round(seconds)), 0)
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"
