"""Estimates of a scene against closed forms, against runs, and against what is allocated."""

import math
import tracemalloc
from dataclasses import replace

import h5py
import numpy as np
import pytest

from eddies.clock import Clock, ProgressLine
from eddies.scene.scene import Time, load_scene
from eddies.workflows.foreseen.numbers import estimate, rollout_in
from eddies.workflows.foreseen.seconds import START, seconds
from eddies.workflows.foreseen.storage import (FLOW_PROCESS, TORCH_PROCESS, Storage, flow_memory, most_disk,
                                               storage)
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


def test_expected_turbulence_agrees_with_the_definitions():
    turbulence = estimate(load_scene("hit-small")).turbulence
    eta, t_eta, nu = turbulence.kolmogorov_length, turbulence.kolmogorov_time, turbulence.viscosity
    assert eta**2 / t_eta == pytest.approx(nu) and nu / t_eta**2 == pytest.approx(turbulence.dissipation_rate)
    # Pope (2000), Eq. 6.64 with k = 3 u'^2 / 2: Re_lambda^2 = 15 u'^4 / (nu eps)
    assert turbulence.reynolds_lambda**2 == pytest.approx(15 * turbulence.velocity_rms**4 / (nu * 0.5))
    decaying = estimate(load_scene("tracers-only")).turbulence
    assert decaying.velocity_rms == 1.0 and decaying.turnover_time == pytest.approx(math.sqrt(2 * math.pi) / 3)


@pytest.mark.parametrize("override, step, limit", [
    ("time.max_step=0.001", 0.001, "max_step"), ("seed=1", 0.01, "courant"), ("time.step=0.004", 0.004, "step"),
    ("time.stepper=rk4", 0.02 / 16, "courant")])
def test_the_step_and_the_key_that_limits_it(override, step, limit):
    expected = estimate(load_scene("hit-small", [override]))
    assert (expected.step, expected.limited_by) == (pytest.approx(step), limit)


@pytest.mark.mpi(1, 2)
def test_speeds_and_steps_are_those_of_the_flow_at_its_start(comm):
    from eddies.flow.statistics import component_energies
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    sound = ["flow.fluid=compressible", "flow.sound_speed=10", "flow.cells=16"]
    for name, changes in (("taylor-green", []), ("abc", ["initial.wavenumber=2"]), ("shear-wave", []),
                          ("tracers-only", ["tracers.particles_per_side=8"])):
        scene = load_scene(name, [*sound, *changes])
        fluid = build_fluid(scene.flow, scene.forcing, comm)
        state = initial_state(scene.initial, scene.seed, fluid)
        energy = sum(component_energies(fluid.grid, state[:3]).values())
        assert estimate(scene).rms_speed == pytest.approx(np.sqrt(2 * energy), rel=1e-6)
        assert estimate(scene).mach == pytest.approx(np.sqrt(2 * energy) / 10, rel=1e-6)
        if name in ("taylor-green", "abc"):
            scene = replace(scene, time=Time(duration=1e9, max_step=1e3))
            taken = build_step_limit(scene.time, scene.flow, fluid.grid)(state, Clock())
            assert estimate(scene).step == pytest.approx(taken)


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
    ["simulation.integrator=rk4", "simulation.step=0.007"], ["simulation.method=eulerian", "simulation.step=0.015"]])
def test_rollouts_take_the_steps_that_are_expected(comm, folder, overrides, monkeypatch):
    from eddies.workflows import simulate
    shown = []
    monkeypatch.setattr(ProgressLine, "__call__", lambda self, done, step: shown.append((done, step)))
    scene = load_scene(folder / "short.toml", overrides)
    simulate.run(scene, comm, folder)
    with h5py.File(folder / "rollout.h5") as file:
        found, frames = dict(file["rollout"].attrs), len(file["particles/model/time"])
    rollout = rollout_in(scene.simulation, found["eddy_turnover_time"], estimate(scene).rollout_step)
    assert (rollout.steps, rollout.intervals) == (found["steps"], frames - 1)
    assert rollout.time_step == pytest.approx(found["time_step"])
    assert rollout.evaluations == found.get("evaluations", 0)
    # The progress line is called after every step, not only at frames.
    assert [step for _, step in shown] == list(range(1, rollout.steps + 1))
    assert all(0 < done <= 1 for done, _ in shown)


def test_what_is_unknown_is_none(own):
    own("own_flow", "class Own:\n    has_density = needs = ()\n"
                    "    advance = frame = status = series = description = 0\n"
                    "def swirl(grid, initial, seed): pass\n")
    for changes in (["simulation.method=own_flow:Own"], ["flow.viscosity=0"]):
        assert estimate(one_model("hit-small", changes)).rollout is None
    assert estimate(load_scene("taylor-green")).rollout is None
    assert seconds(load_scene("taylor-green", ["initial.kind=own_flow:swirl"]), "dns", 1) > 0  # a fixed step
    assert seconds(load_scene("hit-small", ["initial.kind=own_flow:swirl", "flow.viscosity=0"]), "dns", 1) is None


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("fluid", ["compressible", "incompressible"])
def test_memory_of_a_step_is_as_expected(comm, fluid):
    """Arrays that a state, its operators and buffers hold, as counted by the allocator."""
    from eddies.time_stepping import ETDRK4
    from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state
    changes = ["flow.cells=48", f"flow.fluid={fluid}", "initial.kind=taylor-green"]
    scene = load_scene("taylor-green", changes + (["flow.sound_speed=10"] if fluid == "compressible" else []))
    tracemalloc.start()
    equation = build_fluid(scene.flow, scene.forcing, comm)
    stepper, state = ETDRK4(equation), initial_state(scene.initial, scene.seed, equation)
    stepper(state, build_step_limit(scene.time, scene.flow, equation.grid)(state, Clock()))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    expected = flow_memory(scene.flow, scene.tracers, comm.size) - FLOW_PROCESS
    assert 0.4 * expected < peak < 1.1 * expected


def test_memory_falls_with_the_ranks_and_grows_with_the_frames():
    scene = load_scene("hit-small")
    for stage in ("dns", "train-kernel", "train", "find-step", "simulate"):
        sizes = [storage(scene, stage, ranks).memory for ranks in (1, 2, 4, 12)]
        assert sizes == sorted(sizes, reverse=True) and sizes[-1] > FLOW_PROCESS
    few, many = (storage(load_scene("hit-small", [f"training.frames={frames}"]), "train", 1).memory - TORCH_PROCESS
                 for frames in (16, 34))
    assert many == pytest.approx(2 * few)


def test_the_disk_of_the_worst_moment():
    assert most_disk([Storage(0, 4.0, 2.0), Storage(0, None, 9.0), Storage(0, 3.0)]) == 13
    assert most_disk([Storage(0, 2.0)] * 3) == 6
    _, kept, scratch = storage(load_scene("taylor-green", ["flow.cells=256"]), "dns", 1)
    assert kept > 4 * 3 * 256**3 and scratch > 256**3


@pytest.mark.parametrize("stage, override", [
    ("dns", "tracers.turnovers=9.6"), ("train-kernel", "kernel.steps=800"), ("train", "training.frames=64"),
    ("train", "training.horizons.steps=10"), ("train", "model.preset=resolved + pairs"),
    ("simulate", "simulation.step=0.01"), ("find-step", "model.preset=resolved + pairs"),
    ("report", "simulation.turnovers=3")])
def test_more_work_takes_longer_and_more_ranks_less(stage, override):
    given = [] if stage == "find-step" else ["simulation.step=0.13"]
    once, more = one_model("hit-small", given), one_model("hit-small", [*given, override])
    assert seconds(more, stage, 1) > 1.05 * seconds(once, stage, 1)
    assert START[stage] < seconds(more, stage, 2) < seconds(more, stage, 1)


def test_times_of_large_and_of_shortened_stages():
    """The paper's case takes most of a day on 256 ranks: docs/clusters.md."""
    assert 6 < seconds(load_scene("hit-paper"), "dns", 256) / 3600 < 50
    taken = one_model("hit-small", ["model.path=somewhere"])
    assert START["train"] < seconds(taken, "train", 1) < 0.5 * seconds(one_model("hit-small"), "train", 1)


def test_a_memory_of_an_unfiltered_flow_has_eight_times_the_grid_points():
    """Frames of 32^3 tracers on 56^3 grid points; with memory on 112^3 unless the tracers are filtered."""
    def needs(method, filtered):
        scene = load_scene("hit-small", [f"reconstruction.method={method}", f"tracers.filtered={filtered}"],
                           ["kernel", "model", "training", "simulation", "variant"])
        return seconds(scene, "reconstruct", 1), storage(scene, "reconstruct", 1).memory - TORCH_PROCESS

    time, memory = needs("memory", "false")
    assert needs("memory", "true") == needs("least-squares", "true")
    assert needs("least-squares", "false") == needs("least-squares", "true")
    # Beside the grid there are a start of about a second, and the particles.
    assert 6 < time / needs("least-squares", "false")[0] <= 8 and 4 < memory / needs("least-squares", "false")[1] <= 8
