"""Seconds of steps, and whether the machine was busy meanwhile."""

import pytest

from eddies.parallel import step_times
from eddies.parallel.step_times import StepTimes, surplus_load, was_busy


@pytest.mark.mpi(1, 2)
def test_numbers_of_steps_and_of_the_busiest_rank(comm, monkeypatch):
    """Rank r has a load of 3 + r on two cores, and r + 1 switches in a step. Steps take 1, 2, 3, 4, 5 s."""
    now, switches = [0.0], [0]
    monkeypatch.setattr(step_times.time, "perf_counter", lambda: now[0])
    monkeypatch.setattr(step_times, "_involuntary_switches", lambda: switches[0])
    monkeypatch.setattr(step_times.os, "getloadavg", lambda: (3.0 + comm.rank, 0.0, 0.0))
    monkeypatch.setattr(step_times.os, "cpu_count", lambda: 2)
    timed = StepTimes()
    assert timed.numbers(comm) == {}
    for seconds in (90.0, 80.0, 3.0, 1.0, 5.0, 2.0, 4.0):  # the first two are a warm-up
        timed.begin()
        now[0] += seconds
        switches[0] += comm.rank + 1
        timed.end()
        now[0] += 50.0  # storing
        switches[0] += 100
    assert timed.numbers(comm) == {"seconds_per_step_low": 2, "seconds_per_step": 3, "seconds_per_step_high": 4,
                                   "surplus_load": comm.size, "switches_per_step": comm.size}


@pytest.mark.parametrize("high, surplus, busy", [(1.5, 0.5, False), (1.51, -2.0, True), (1.0, 0.51, True)])
def test_a_busy_machine_has_a_load_or_steps_of_different_times(high, surplus, busy):
    numbers = {"seconds_per_step_low": 1.0, "seconds_per_step_high": high, "surplus_load": surplus}
    assert was_busy(numbers) is busy
    del numbers["surplus_load"]
    assert was_busy(numbers) is (high > 1.5) and was_busy({}) is False


def test_a_system_that_does_not_give_its_load_is_not_busy(monkeypatch):
    def unknown():
        raise OSError

    monkeypatch.setattr(step_times.os, "getloadavg", unknown)
    assert surplus_load() < 0
