"""Steps, evaluations and frames of rollouts, and the bytes of their files: foreseen against what rollouts do."""

import h5py
import numpy as np
import pytest

from eddies.clock import ProgressLine
from eddies.scene.scene import load_scene
from eddies.workflows.foreseen.rollout_course import RolloutCourse, rollout_course
from eddies.workflows.foreseen.stored import rollout_bytes, trajectory_bytes

SCENE = """
[flow]
fluid = "compressible"
cells = 16
viscosity = 0.05
sound_speed = 15.0
[tracers]
particles_per_side = 8
turnovers = 0.3
frame_interval = 0.02
field_every = 2
[simulation]
method = "none"
step = 0.03
turnovers = 0.2
frame_interval = 0.04
start = 0
"""


@pytest.fixture(scope="module")
def folder(comm, tmp_path_factory):
    """A run directory with a scene and its ground truth."""
    from eddies.workflows import dns
    path = tmp_path_factory.mktemp("course")
    (path / "short.toml").write_text(SCENE)
    dns.run(load_scene(path / "short.toml"), comm, path)
    return path


def stored(file):
    """Bytes of particles and fields in a file, but for times and numbers of steps."""
    found = {}
    for group in (file[name] for name in ("particles", "fields") if name in file):
        group.visititems(lambda name, part: found.update(
            {part.id: part.id.get_storage_size()} if isinstance(part, h5py.Dataset) and (
                part.ndim > 1 or name.endswith("/id")) else {}))
    return sum(found.values())


@pytest.mark.mpi(1)
@pytest.mark.parametrize("overrides", [
    [], ["simulation.step=0.3"], ["simulation.integrator=verlet", "simulation.step=0.02"],
    ["simulation.integrator=rk2", "simulation.step=0.04", "simulation.frame_interval=0.02"],
    ["simulation.integrator=rk4", "simulation.step=0.007"],
    ["simulation.method=eulerian", "simulation.step=0.015"]])
def test_a_rollout_takes_the_steps_that_are_foreseen(comm, folder, overrides, monkeypatch):
    from eddies.workflows import simulate
    shown = []
    monkeypatch.setattr(ProgressLine, "__call__", lambda self, done, step: shown.append((done, step)))
    scene = load_scene(folder / "short.toml", overrides)
    simulate.run(scene, comm, folder)
    with h5py.File(folder / "rollout.h5") as file:
        found, times = dict(file["rollout"].attrs), file["particles/model/time"][()]
        steps, size = file["particles/model/step"][()], stored(file)
    course = rollout_course(scene, found["eddy_turnover_time"])
    assert (course.steps, course.intervals) == (found["steps"], len(times) - 1)
    assert np.array_equal(course.steps_to_frames, steps)
    assert course.time_step == pytest.approx(found["time_step"])
    if course.stages:
        assert course.evaluations == found["evaluations"]
    assert rollout_bytes(scene, course) == size
    # Progress is shown by time, so it is told after every step, and not only at frames.
    assert [step for _, step in shown] == list(range(1, course.steps + 1))
    assert all(0 < done <= 1 for done, _ in shown)


@pytest.mark.mpi(1)
def test_frames_of_a_ground_truth_take_the_bytes_that_are_foreseen(folder):
    scene = load_scene(folder / "short.toml")
    with h5py.File(folder / "ground_truth.h5") as file:
        assert trajectory_bytes(scene, len(file["particles/tracers/time"])) == stored(file)


def test_evaluations_of_frames_are_those_between_steps():
    between = RolloutCourse(1.0, 0.1, 6, 0.08, 3, True)
    assert (between.steps, between.evaluations, between.evaluations_of_frames) == (8, 25, 5)  # 0.4 is on a step
    on_steps = RolloutCourse(1.0, 0.1, 6, 0.05, 3, True)
    assert (on_steps.steps, on_steps.steps_per_frame, on_steps.evaluations_of_frames) == (12, 2.0, 0)
    assert on_steps.evaluations_per_turnover == pytest.approx(37 / 0.6)


def test_what_is_not_foreseen_has_no_course(own):
    own("own_method", "class Own:\n    has_density = needs = ()\n"
                      "    advance = frame = status = series = description = 0\n")
    for changes in (["simulation.method=own_method:Own"], ["flow.viscosity=0"]):
        assert rollout_course(load_scene("hit-small", changes)) is None
    assert rollout_course(load_scene("taylor-green")) is None


def test_particles_of_a_decaying_flow_may_take_longer_steps():
    from eddies.workflows.foreseen.estimates import expected_turbulence, foreseen_allowed_step
    free, forced = (foreseen_allowed_step(load_scene("hit-small", [f"simulation.injection={name}"]))
                    for name in ("none", "dissipation"))
    assert 1.1 * forced < free < 1.5 * forced
    turbulence, interval = expected_turbulence(load_scene("hit-small")), 1e-4
    lost = 1.5 * (turbulence.decayed(0.0)**2 - turbulence.decayed(interval)**2) / interval
    assert lost == pytest.approx(turbulence.dissipation_rate, rel=1e-3)
