"""The progress line: by wall time, also between frames, with the seconds of a step and the remaining time."""

import logging
import re

import pytest

from eddies import clock
from eddies.clock import ProgressLine


@pytest.fixture
def progressed(monkeypatch, caplog):
    """A function that lets steps take some seconds each, by a wall clock of its own, and gives the lines: seconds a
    step, percent, and the remaining time."""
    now = [100.0]
    monkeypatch.setattr(clock.time, "perf_counter", lambda: now[0])
    caplog.set_level(logging.INFO, logger="eddies")
    pattern = re.compile(r"(\S+) s/step(?: \(storing: \d+ % of the time\))?  (\d+) %  (.+) left")

    def run(steps, of, storing=0.0, renewed_at=None, interval=5.0, done=0.0):
        monkeypatch.setattr(clock, "INTERVAL", interval)
        progress = ProgressLine("stage", lambda: "state", done)
        for step, seconds in enumerate(steps, 1):
            if step == renewed_at:
                progress.renew()
            with progress.storing():
                now[0] += storing
            now[0] += seconds
            progress(progress.done + step / of, step)
        return [pattern.search(record.getMessage()).groups() for record in caplog.records if "left" in record.msg]

    return run


def test_lines_come_by_time_and_not_by_steps(progressed):
    assert progressed(20 * [1], of=40) == [("1.000", "12", "35 s"), ("1.000", "25", "30 s"), ("1.000", "38", "25 s"),
                                           ("1.000", "50", "20 s")]


def test_the_work_of_an_earlier_job_is_no_measure_of_the_remaining_time(progressed):
    assert progressed([10], of=10, done=0.5) == [("10.000", "60", "40 s")]


def test_a_step_counts_without_warm_up_and_storing(progressed, caplog):
    """Two steps of 4 s, two of 1 s, and 2.5 s to store each: half of 20 s is storing."""
    assert progressed([4, 4, 1, 1], of=8, storing=2.5, interval=20.0) == [("1.000", "50", "20 s")]
    assert "1.000 s/step (storing: 50 % of the time)" in caplog.text


def test_steps_of_another_kind_have_a_median_of_their_own(progressed):
    assert progressed([1, 1, 1, 1, 8, 8], of=12, renewed_at=5, interval=20.0) == [("8.000", "50", "20 s")]


def test_with_verbose_there_is_a_line_for_every_step(progressed, caplog):
    caplog.set_level(logging.DEBUG, logger="eddies")
    assert progressed([1, 1], of=4) == [("1.000", "25", "3 s"), ("1.000", "50", "2 s")]


@pytest.mark.parametrize("seconds, text", [(41.6, "42 s"), (200, "3 min 20 s"), (7500, "2 h 05 min"),
                                           (3.2e8, "10 years"), (86400 * 365.25 * 1.2e30, "1.2e+30 years")])
def test_durations_are_readable(seconds, text):
    assert clock.duration(seconds) == text
