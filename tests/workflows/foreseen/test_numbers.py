"""Turbulence and steps that are known before a run: against closed forms, and against what runs do."""

import math
from dataclasses import replace

import h5py
import pytest

from eddies.clock import ProgressLine
from eddies.scene.scene import Time, load_scene
from eddies.workflows.foreseen.numbers import expected_allowed_step, expected_step, expected_turbulence, rollout_of
from eddies.workflows.foreseen.storage import rollout_bytes, trajectory_bytes
from tests.small_scene import one_model

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


def test_expected_turbulence_is_consistent():
    turbulence = expected_turbulence(load_scene("hit-small"))
    eta, t_eta, nu = turbulence.kolmogorov_length, turbulence.kolmogorov_time, turbulence.viscosity
    assert eta**2 / t_eta == pytest.approx(nu)
    assert nu * (1 / t_eta) ** 2 == pytest.approx(turbulence.dissipation_rate)
    # Pope (2000), Eq. 6.64 with k = 3 u'^2 / 2: Re_lambda^2 = 15 u'^4 / (nu eps)
    assert turbulence.reynolds_lambda**2 == pytest.approx(15 * turbulence.velocity_rms**4 / (nu * 0.5))


def test_random_start_decays_from_its_own_scales():
    turbulence = expected_turbulence(load_scene("tracers-only"))
    assert turbulence.velocity_rms == 1.0
    assert turbulence.turnover_time == pytest.approx(math.sqrt(2 * math.pi) / 3)


@pytest.mark.parametrize("overrides, step, limit", [
    (["time.max_step=0.001"], 0.001, "max_step"),
    ([], 0.01, "advection"),
    (["time.stepper=rk4"], 0.02 / 16, "sound"),
    (["time.step=0.004"], 0.004, "fixed"),
])
def test_what_limits_the_step(overrides, step, limit):
    found, reason = expected_step(load_scene("hit-small", overrides))
    assert found == pytest.approx(step) and limit in reason


@pytest.mark.mpi(1)
def test_expected_step_is_the_one_taken_at_the_start(comm):
    from eddies.clock import Clock
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    for name in ("taylor-green", "abc"):
        scene = replace(load_scene(name), time=Time(duration=1e9, max_step=1e3))
        fluid = build_fluid(scene, comm)
        taken = build_step_limit(scene, fluid.grid)(initial_state(scene, fluid), Clock())
        assert expected_step(scene)[0] == pytest.approx(taken)


@pytest.fixture(scope="module")
def folder(comm, tmp_path_factory):
    """A run directory with a scene and its ground truth."""
    from eddies.workflows import dns
    path = tmp_path_factory.mktemp("rollout")
    (path / "short.toml").write_text(SCENE)
    dns.run(load_scene(path / "short.toml"), comm, path)
    return path


@pytest.mark.mpi(1)
@pytest.mark.parametrize("overrides", [
    [], ["simulation.step=0.3"], ["simulation.integrator=verlet", "simulation.step=0.02"],
    ["simulation.integrator=rk2", "simulation.step=0.04", "simulation.frame_interval=0.02"],
    ["simulation.integrator=rk4", "simulation.step=0.007"],
    ["simulation.method=eulerian", "simulation.step=0.015"]])
def test_a_rollout_takes_the_steps_that_are_expected(comm, folder, overrides, monkeypatch):
    from eddies.workflows import simulate
    shown = []
    monkeypatch.setattr(ProgressLine, "__call__", lambda self, done, step: shown.append((done, step)))
    scene = load_scene(folder / "short.toml", overrides)
    simulate.run(scene, comm, folder)
    with h5py.File(folder / "rollout.h5") as file:
        found, frames = dict(file["rollout"].attrs), len(file["particles/model/time"])
    rollout = rollout_of(scene, found["eddy_turnover_time"])
    assert (rollout.steps, rollout.intervals) == (found["steps"], frames - 1)
    assert rollout.time_step == pytest.approx(found["time_step"])
    assert rollout.evaluations == found.get("evaluations", 0)
    # Of files this small, a third is headers and words.
    assert (folder / "rollout.h5").stat().st_size == pytest.approx(rollout_bytes(scene, rollout), rel=0.5)
    # Progress is shown by time, so it is told after every step, and not only at frames.
    assert [step for _, step in shown] == list(range(1, rollout.steps + 1))
    assert all(0 < done <= 1 for done, _ in shown)


@pytest.mark.mpi(1)
def test_frames_of_a_ground_truth_take_the_bytes_that_are_expected(folder):
    scene = load_scene(folder / "short.toml")
    with h5py.File(folder / "ground_truth.h5") as file:
        frames = len(file["particles/tracers/time"])
    assert (folder / "ground_truth.h5").stat().st_size == pytest.approx(trajectory_bytes(scene, frames), rel=0.5)


def test_rollouts_of_methods_of_the_users_are_not_known(own):
    own("own_method", "class Own:\n    has_density = needs = ()\n"
                      "    advance = frame = status = series = description = 0\n")
    for changes in (["simulation.method=own_method:Own"], ["flow.viscosity=0"]):
        assert rollout_of(one_model("hit-small", changes)) is None
    assert rollout_of(load_scene("taylor-green")) is None


def test_particles_of_a_decaying_flow_may_take_longer_steps():
    free, forced = (expected_allowed_step(one_model("hit-small", [f"simulation.injection={name}"]))
                    for name in ("none", "dissipation"))
    assert 1.1 * forced < free < 1.5 * forced
    turbulence, interval = expected_turbulence(load_scene("hit-small")), 1e-4
    lost = 1.5 * (turbulence.decayed(0.0)**2 - turbulence.decayed(interval)**2) / interval
    assert lost == pytest.approx(turbulence.dissipation_rate, rel=1e-3)
