"""The course of a rollout: its steps, frames and times."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.clock import ProgressLine
from eddies.io.frame_segments import FrameSegments
from eddies.io.checkpoint import Guard
from eddies.io.hdf5 import create_product, open_product
from eddies.io.trajectories import Trajectory
from eddies.particles.particle_set import ParticleSet
from eddies.parallel.stop import Stopped
from eddies.workflows.rollout.course import Course, frame_layout, quartiles
from tests.workflows.stopping import StopAtStep


class Standing:
    """Particles at rest, in steps of 0.1."""

    def __init__(self):
        self.time = 0.0

    def advance(self, until, number):
        self.time += 0.1

    def frame(self, time):
        return SimpleNamespace(velocity=torch.zeros(1, 3), to_numpy=dict), torch.zeros(1, 3)

    def status(self):
        return ""

    def state_dict(self):
        return {"time": self.time}

    def load_state_dict(self, saved):
        self.time = saved["time"]


class Still(Course):
    """Records times and steps of the frames."""

    def _store(self, at):
        self.times.append(at)
        self.stored = [*getattr(self, "stored", []), self.steps]


def course_of(comm, directory, looks=10**9, method=Standing, count=4, interval=0.25):
    guard = Guard(comm, directory, "settings", StopAtStep(comm, looks))
    segments = SimpleNamespace(comm=comm, names=[], close=lambda: None)
    return Still(method(), segments, count, interval, guard, guard.checkpoints.newest())


@pytest.mark.mpi(1)
def test_each_part_of_a_run_has_a_warm_up_that_is_not_timed(comm, tmp_path, monkeypatch):
    shown = []
    monkeypatch.setattr(ProgressLine, "__call__", lambda self, done, step: shown.append(step))
    whole = course_of(comm, tmp_path / "whole")
    outcome = whole.run()
    assert outcome["status"] == "complete" and outcome["steps"] == 10 and len(whole.seconds) == 8
    assert whole.times == [0, 0.25, 0.5, 0.75, 1] and whole.stored == [0, 3, 5, 8, 10]
    assert shown == [*range(1, 11)]  # also after steps between frames
    first = course_of(comm, tmp_path / "parts", 5)
    with pytest.raises(Stopped, match="from step 5"):
        first.run()
    second = course_of(comm, tmp_path / "parts")
    assert second.progress.done == pytest.approx(0.5) and second.seconds == first.seconds and len(first.seconds) == 3
    assert second.run()["steps"] == 10 and len(second.seconds) == 3 + 3
    assert second.times == whole.times and second.stored == [8, 10]


class Falling(Standing):
    """Particles whose first step fails."""

    def advance(self, until, number):
        return "fell"


@pytest.mark.mpi(2)
def test_times_are_those_of_timed_steps_on_the_same_ranks(comm, tmp_path):
    """The first two steps are a warm-up. A step that fails has neither a time nor a length."""
    alone, place = comm.Split(comm.rank), tmp_path / f"rank-{comm.rank}"
    timed = {"seconds_per_step", "seconds_per_step_low", "seconds_per_step_high"}
    found = [course_of(alone, place, count=1, interval=interval).run() for interval in (0.25, 0.2)]
    assert [outcome["steps"] for outcome in found] == [3, 2]
    assert timed < found[0].keys() and not timed & found[1].keys() and found[1]["time_step"] == pytest.approx(0.1)
    assert quartiles([1.0, 2.0, 3.0, 4.0, 5.0]) == dict(zip(sorted(timed), (3.0, 4.0, 2.0)))
    fallen = course_of(alone, place, method=Falling).run()
    assert fallen == {"status": "stopped: fell", "time": 0.0, "steps": 0}
    with pytest.raises(Stopped):
        course_of(comm, tmp_path / "run", 5).run()
    if comm.rank == 0:
        course = course_of(alone, tmp_path / "run")
        assert course.steps == 5 and course.seconds == []
    comm.Barrier()


class Carried(Standing):
    """Particles in reverse order, not on the ranks of their slabs, some outside the box."""

    def __init__(self, comm, total, density):
        super().__init__()
        ids = np.arange(total)[::-1]
        own = ids[ids % comm.size == comm.rank]
        self.columns = {"id": own, "position": own[:, None] + np.array([0.5, 7.0, -1.0]),
                        "velocity": own[:, None] * np.ones(3)} | ({"density": 2.0 + own} if density else {})

    def frame(self, time):
        return ParticleSet.from_numpy(self.columns), torch.full((len(self.columns["id"]), 3), time)


@pytest.mark.mpi(1, 3)
def test_a_frame_holds_the_particles_of_the_method_in_order_of_id(comm, tmp_path):
    total, length, density = 7, 2 * np.pi, comm.size == 3
    guard = Guard(comm, tmp_path / "checkpoints", "settings", StopAtStep(comm, 10**9))
    with FrameSegments(comm, tmp_path / "checkpoints", frame_layout(total, length, density)) as segments:
        course = Course(Carried(comm, total, density), segments, 2, 0.1, guard, None)
        course.run()
        with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
            segments.assemble(file)
    assert course.energy == pytest.approx(1.5 * np.var(np.arange(total)))  # without the mean
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        assert list(file["particles"]) == ["model"] and "fields" not in file
        stored, ids = Trajectory(file, "model"), np.arange(total)
        assert set(stored.columns) == {"position", "image", "velocity", "acceleration"} | (
            {"density"} if density else set())
        assert stored.times == pytest.approx([0, 0.1, 0.2])
        assert stored.read(0, "position") == pytest.approx((ids[:, None] + [0.5, 7.0, -1.0]) % length, abs=1e-6)
        assert np.array_equal(stored.read(2, "velocity"), ids[:, None] * np.ones(3))
        assert stored.read(2, "acceleration") == pytest.approx(np.full((total, 3), 0.2))
        assert not density or stored.read(1, "density").tolist() == (2.0 + ids).tolist()
