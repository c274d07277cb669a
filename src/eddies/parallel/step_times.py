"""Wall seconds of steps, and whether the machine was busy while they were measured.

On a busy machine the ranks wait for each other, and a step takes several times as long. Such times are not comparable.
"""

import os
import resource
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from eddies.clock import WARM_UP_STEPS
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max

LARGEST_SURPLUS = 0.5   # a job on all cores has a load of about their number; each further process adds 1
LARGEST_RATIO = 1.5     # of the upper to the lower quartile of the seconds of a step


class StepTimes:
    """Wall seconds of the steps of this rank, and what else the machine did meanwhile.

    The first WARM_UP_STEPS, which plan, compile and fill caches, are not timed. A row of `rows` belongs to a timed
    step: its wall seconds, `surplus_load` at its end, and the involuntary context switches of this process meanwhile.
    These include the switches of a process that yields while it waits for a message.
    """

    def __init__(self) -> None:
        self.rows: list[Sequence[float]] = []
        self._warm_up, self._began, self._switches = WARM_UP_STEPS, 0.0, 0

    def begin(self) -> None:
        """Begin a step."""
        self._began, self._switches = time.perf_counter(), _involuntary_switches()

    def end(self) -> None:
        """End the step that has begun."""
        if self._warm_up > 0:
            self._warm_up -= 1
        else:
            seconds, switches = time.perf_counter() - self._began, _involuntary_switches() - self._switches
            self.rows.append((seconds, surplus_load(), switches))

    def numbers(self, comm: Comm) -> dict[str, float]:
        """Return numbers on the timed steps; collective. Without timed steps the result is empty.

        These are the quartiles of the wall seconds of a step, `seconds_per_step_low`, `seconds_per_step` and
        `seconds_per_step_high`; the median `surplus_load`; and `switches_per_step`, the mean number of involuntary
        context switches. The last two are the largest of all ranks.
        """
        if not self.rows:
            return {}
        seconds, loads, switches = np.transpose(self.rows)
        most = global_max(comm, np.array([np.median(loads), switches.mean()]))
        return {**quartiles(seconds), "surplus_load": float(most[0]), "switches_per_step": float(most[1])}


def quartiles(seconds: Sequence[float] | np.ndarray) -> dict[str, float]:
    """Return the median of the wall seconds of steps, `seconds_per_step`, and their quartiles, `seconds_per_step_low`
    and `seconds_per_step_high`."""
    low, median, high = np.quantile(seconds, (0.25, 0.5, 0.75))
    return {"seconds_per_step": median, "seconds_per_step_low": low, "seconds_per_step_high": high}


def surplus_load() -> float:
    """Return the load average of the machine over the last minute less the number of its cores.

    The load average is the mean number of processes that run or wait for a core. It counts as 0 if the system does not
    give it.
    """
    try:
        load = os.getloadavg()[0]
    except OSError:
        load = 0.0
    return load - (os.cpu_count() or 1)


def was_busy(numbers: Mapping[str, Any]) -> bool:
    """Return whether the machine was busy while steps were timed; `numbers` are those of `StepTimes.numbers`.

    It was busy if the load exceeded the cores by more than LARGEST_SURPLUS, or if the ratio of the quartiles of a step
    is larger than LARGEST_RATIO. A number that is missing, as in files of earlier versions, is no reason.
    """
    low, high = numbers.get("seconds_per_step_low", 0.0), numbers.get("seconds_per_step_high", 0.0)
    return bool(high > LARGEST_RATIO * low or numbers.get("surplus_load", 0.0) > LARGEST_SURPLUS)


def _involuntary_switches() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_nivcsw
