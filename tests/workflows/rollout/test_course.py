"""The course of a rollout: how often it steps and stores, and what its steps took."""

from types import SimpleNamespace

import pytest
import torch

from eddies.io.guard import Guard
from eddies.parallel.stop import Stopped
from eddies.workflows.rollout.course import Course
from tests.workflows.stopping import StopAtStep


class Standing:
    """Particles that stand still, in steps of 0.1."""

    def __init__(self):
        self.time = 0.0

    def advance(self, until, number):
        self.time += 0.1

    def frame(self, time):
        return SimpleNamespace(velocity=torch.zeros(1, 3)), torch.zeros(1, 3)

    def status(self):
        return ""

    def state_dict(self):
        return {"time": self.time}

    def load_state_dict(self, saved):
        self.time = saved["time"]


class Frames:
    """Takes down times and steps of the frames."""

    segments = None

    def __init__(self, comm):
        self.truth, self.times, self.steps = SimpleNamespace(decomposition=SimpleNamespace(comm=comm), total=1), [], []

    def store(self, step, time, particles, acceleration, near):
        self.times.append(time)
        self.steps.append(step)

    def state_dict(self):
        return {"times": self.times}

    def load_state_dict(self, state):
        self.times = state["times"]


def course_of(comm, directory, looks=10**9, method=Standing, count=4, interval=0.25):
    guard = Guard(comm, directory, "settings", StopAtStep(comm, looks))
    return Course(method(), Frames(comm), count, interval, guard, guard.checkpoints.newest())


@pytest.mark.mpi(1)
def test_parts_of_a_run_leave_out_a_warm_up_each(comm, tmp_path):
    whole = course_of(comm, tmp_path / "whole")
    outcome = whole.run()
    assert outcome["status"] == "complete" and outcome["steps"] == 10 and len(whole.seconds) == 8
    assert whole.frames.times == [0, 0.25, 0.5, 0.75, 1] and whole.frames.steps == [0, 3, 5, 8, 10]
    first = course_of(comm, tmp_path / "parts", 5)
    with pytest.raises(Stopped, match="from step 5"):
        first.run()
    second = course_of(comm, tmp_path / "parts")
    assert second.progress.done == pytest.approx(0.5) and second.seconds == first.seconds and len(first.seconds) == 3
    assert second.run()["steps"] == 10 and len(second.seconds) == 3 + 3
    assert second.frames.times == whole.frames.times and second.frames.steps == [8, 10]


class Falling(Standing):
    """Particles of which the first step goes wrong."""

    def advance(self, until, number):
        return "fell"


@pytest.mark.mpi(1)
def test_what_was_not_measured_is_not_there(comm, tmp_path):
    """The first two steps are a warm-up; of one that goes wrong there is neither time nor length."""
    timed = {"seconds_per_step", "seconds_per_step_low", "seconds_per_step_high"}
    found = [course_of(comm, tmp_path, count=1, interval=interval).run() for interval in (0.25, 0.2)]
    assert [outcome["steps"] for outcome in found] == [3, 2]
    assert timed < found[0].keys() and not timed & found[1].keys() and found[1]["time_step"] == pytest.approx(0.1)
    fallen = course_of(comm, tmp_path, method=Falling).run()
    assert fallen == {"status": "stopped: fell", "time": 0.0, "steps": 0}


@pytest.mark.mpi(2)
def test_seconds_on_another_number_of_ranks_are_those_since_then(comm, tmp_path):
    with pytest.raises(Stopped):
        course_of(comm, tmp_path / "run", 5).run()
    alone = comm.Split(comm.rank)
    if comm.rank == 0:
        course = course_of(alone, tmp_path / "run")
        assert course.steps == 5 and course.seconds == []
    comm.Barrier()
