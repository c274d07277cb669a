"""Estimates of a scene against closed forms and against runs."""

import math
from dataclasses import replace

import numpy as np
import pytest

from eddies.clock import Clock
from eddies.io.hdf5 import open_product, read_attributes
from eddies.io.trajectories import Trajectory
from eddies.scene.scene import Time, load_scene
from eddies.workflows.estimates import estimate, measure
from tests.small_scene import one_model


def test_expected_turbulence_agrees_with_the_definitions():
    scales, nu = estimate(load_scene("hit-small")).scales, load_scene("hit-small").flow.viscosity
    # Pope (2000), Eq. 6.64 with k = 3 u'^2 / 2: Re_lambda^2 = 15 u'^4 / (nu eps)
    assert scales["reynolds_lambda"]**2 == pytest.approx(15 * scales["velocity_rms"]**4 / (nu * 0.5))
    decaying = estimate(load_scene("tracers-only")).scales
    assert decaying["velocity_rms"] == 1.0
    assert decaying["eddy_turnover_time"] == pytest.approx(math.sqrt(2 * math.pi) / 3)


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


@pytest.mark.mpi(1, 2)
def test_a_flow_from_a_file_has_the_scales_steps_and_frames_of_its_run(comm, tmp_path):
    """The first run is the start of the second, which releases its tracers at once."""
    from eddies.workflows import dns
    folder, small = comm.bcast(tmp_path), ["flow.cells=16", "flow.viscosity=0.03"]
    first = load_scene("tracers-only", [*small, "time.duration=0.2", "time.max_step=0.02"], ["tracers"])
    for name in ("first", "second"):
        (folder / name).mkdir(exist_ok=True)
    dns.run(first, comm, folder / "first")
    scene = load_scene("tracers-only", [
        *small, "time.courant=0.5", "initial.kind=file", f"initial.path={folder / 'first'}",
        "tracers.particles_per_side=6", "tracers.frame_interval=0.02", "tracers.turnovers=0.3"],
        ["initial.amplitude", "initial.peak_wavenumber"])
    assert estimate(scene).scales is None
    measured, problems = measure([scene, scene], comm)
    expected = estimate(scene, measured)
    dns.run(scene, comm, folder / "second")
    with open_product(comm, folder / "second/ground_truth.h5", "ground_truth") as file:
        reference, trajectory = read_attributes(file, "reference"), Trajectory(file, "tracers")
        frames, steps = len(trajectory.times), trajectory.steps[-1]
    names = {"velocity_rms", "eddy_turnover_time", "dissipation_rate", "reynolds_lambda", "kolmogorov_length"}
    # The velocity of the particles is filtered, so `velocity_rms` of the reference is theirs.
    assert problems == [] and all(expected.scales[name] == pytest.approx(reference[name], rel=1e-12)
                                  for name in names - {"velocity_rms"})
    assert expected.scales["velocity_rms"] ** 2 == pytest.approx(2 / 3 * reference["energy"], rel=1e-12)
    # The flow decays, so that its later steps may be longer.
    assert expected.frames == frames and 1 <= expected.steps / steps < 1.3


@pytest.mark.mpi(1, 2)
def test_what_is_unknown_is_none(comm, own):
    own("own_flow", "def swirl(grid, initial, seed): pass\n")
    inviscid = estimate(one_model("hit-small", ["flow.viscosity=0"]))
    assert inviscid.scales is inviscid.frames is inviscid.steps is None and inviscid.step > 0
    assert estimate(load_scene("taylor-green", ["initial.kind=own_flow:swirl"])).steps == 100  # a fixed step
    scene = load_scene("hit-small", ["initial.kind=own_flow:swirl", "flow.viscosity=0"])
    assert estimate(scene).step is None
    missing = load_scene("taylor-green", ["initial.kind=file", "initial.path=nowhere.h5"])
    measured, (problem,) = measure([scene, missing], comm)
    assert measured == {} and "nowhere.h5: no such file" in problem
