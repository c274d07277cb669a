"""Spans and equal times in any unit. The progress line: by wall time, also between frames, with the seconds of a step
and the remaining time."""

import logging
import re

import numpy as np
import pytest

from eddies import clock
from eddies.analysis.rollout import same_times
from eddies.clock import Clock, ProgressLine
from eddies.flow.stability import FixedStep

UNITS = [1e-15, 1e-6, 1.0, 1e6, 1e15]


@pytest.mark.parametrize("began", [0.0, 1.0, 1e7])
@pytest.mark.parametrize("unit", UNITS)
def test_a_span_takes_all_its_steps_and_no_other_in_any_unit_of_time(unit, began):
    """Steps of a tenth of a span add up to it with round-off, also after a time that is ten million times as long."""
    now, step = Clock(), FixedStep(0.3 * unit / 10)
    now.tick(began * unit)
    for spans in (1, 2):
        now.begin(0.3 * unit)
        while now.running:
            now.tick(step(None, now))
        assert now.steps == 10 * spans + 1 and now.elapsed == pytest.approx(0.3 * unit, rel=1e-12)
    assert now.time == pytest.approx((began + 0.6) * unit, rel=1e-12)


def test_a_stopped_span_has_nothing_left_and_a_clock_can_be_restored():
    now, again = Clock(), Clock()
    assert now.running and now.remaining == np.inf
    now.tick(1e-300)
    now.stop()
    assert not now.running and now.remaining == 0.0
    now.begin(2.0)
    now.tick(0.5)
    again.load_state_dict(now.state_dict())
    assert (again.time, again.remaining, again.steps) == (now.time, 1.5, 2)


@pytest.mark.parametrize("unit", UNITS)
def test_times_are_the_same_relative_to_their_interval(unit):
    first, second = unit * np.array([0.0, 0.5, 1.0, 1.5]), unit * np.array([0.0, 0.25, 0.5000001, 0.75, 1.01])
    assert [rows.tolist() for rows in same_times(first, second)] == [[0, 1], [0, 2]]
    assert [rows.tolist() for rows in same_times(first[1:2], unit * np.array([0.5000001]))] == [[0], [0]]
    assert [rows.tolist() for rows in same_times(first, np.zeros(0))] == [[], []]


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


@pytest.mark.parametrize("steps, given, lines", [
    (20 * [1], dict(of=40), [("1.000", "12", "35 s"), ("1.000", "25", "30 s"), ("1.000", "38", "25 s"),
                             ("1.000", "50", "20 s")]),
    ([10], dict(of=10, done=0.5), [("10.000", "60", "40 s")]),
    ([1, 1, 1, 1, 8, 8], dict(of=12, renewed_at=5, interval=20.0), [("8.000", "50", "20 s")])],
    ids=["by time and not by steps", "without the work of an earlier job", "for steps of another kind alone"])
def test_lines_give_the_median_of_steps_and_the_remaining_time(progressed, steps, given, lines):
    assert progressed(steps, **given) == lines


def test_a_step_counts_without_warm_up_and_storing(progressed, caplog):
    """Two steps of 4 s, two of 1 s, and 2.5 s to store each: half of 20 s is storing."""
    assert progressed([4, 4, 1, 1], of=8, storing=2.5, interval=20.0) == [("1.000", "50", "20 s")]
    assert "1.000 s/step (storing: 50 % of the time)" in caplog.text


def test_with_verbose_there_is_a_line_for_every_step(progressed, caplog):
    caplog.set_level(logging.DEBUG, logger="eddies")
    assert progressed([1, 1], of=4) == [("1.000", "25", "3 s"), ("1.000", "50", "2 s")]


@pytest.mark.parametrize("seconds, text", [(41.6, "42 s"), (200, "3 min 20 s"), (7500, "2 h 05 min"),
                                           (3.2e8, "10 years"), (86400 * 365.25 * 1.2e30, "1.2e+30 years")])
def test_durations_are_readable(seconds, text):
    assert clock.duration(seconds) == text
