"""The progress line: by wall time, also between frames, and what it says of a step and of the time left."""

import logging
import re

import pytest

from eddies import clock
from eddies.clock import ProgressLine


@pytest.fixture
def wall(monkeypatch):
    """A wall clock that a test moves on: a list of the time now."""
    now = [100.0]
    monkeypatch.setattr(clock.time, "perf_counter", lambda: now[0])
    return now


@pytest.fixture
def lines(caplog):
    """The lines so far: seconds a step, percent, and what is left."""
    caplog.set_level(logging.INFO, logger="eddies")
    pattern = re.compile(r"(\S+) s/step(?: \(storing: \d+ % of the time\))?  (\d+) %  (.+) left")
    return lambda: [pattern.search(record.getMessage()).groups() for record in caplog.records]


def test_lines_come_by_time_and_not_by_steps(wall, lines):
    progress = ProgressLine("stage", lambda: "state")
    for step in range(1, 21):
        wall[0] += 1
        progress(step / 40, step)
    assert lines() == [("1.000", "12", "35 s"), ("1.000", "25", "30 s"), ("1.000", "38", "25 s"),
                       ("1.000", "50", "20 s")]


def test_what_an_earlier_job_did_is_no_measure_of_what_is_left(wall, lines):
    progress = ProgressLine("stage", lambda: "state", done=0.5)
    wall[0] += 10
    progress(0.6, 1010)
    assert lines() == [("10.000", "60", "40 s")]


def test_a_step_is_told_without_its_warm_up_and_what_is_stored(wall, lines, caplog):
    """Two steps of 4 s, two of 1 s, and 2.5 s to store each: of 20 s half is storing."""
    progress = ProgressLine("stage", lambda: "state", interval=20.0)
    for step, seconds in enumerate((4, 4, 1, 1), 1):
        with progress.storing():
            wall[0] += 2.5
        wall[0] += seconds
        progress(step / 8, step)
    assert lines() == [("1.000", "50", "20 s")]
    assert "1.000 s/step (storing: 50 % of the time)" in caplog.text and progress.storing_share == 0.5


def test_steps_of_another_kind_have_a_median_of_their_own(wall, lines):
    progress = ProgressLine("stage", lambda: "state", interval=20.0)
    for step, seconds in enumerate((1, 1, 1, 1, 8, 8), 1):
        if step == 5:
            progress.renew()
        wall[0] += seconds
        progress(step / 12, step)
    assert lines() == [("8.000", "50", "20 s")]


def test_where_more_is_logged_there_is_a_line_for_every_step(wall, lines, caplog):
    caplog.set_level(logging.DEBUG, logger="eddies")
    progress = ProgressLine("stage", lambda: "state")
    for step in (1, 2):
        wall[0] += 1
        progress(step / 4, step)
    assert lines() == [("1.000", "25", "3 s"), ("1.000", "50", "2 s")]
