"""Estimates of a scene against closed forms, against runs, and against what is allocated, stored and accepted."""

import math
import tracemalloc
from contextlib import nullcontext
from dataclasses import replace

import h5py
import numpy as np
import pytest

from eddies.clock import Clock
from eddies.io.hdf5 import open_product, read_attributes
from eddies.io.trajectories import Trajectory
from eddies.particles.flow_units import planes_for
from eddies.scene.scene import Time, load_scene
from eddies.workflows.estimates import (FLOW_PROCESS, TORCH_PROCESS, Storage, estimate, flow_memory, forces_rollout,
                                        measure, most_disk, most_ranks, storage)
from eddies.workflows.learned.source import ModelDefinition
from tests.small_scene import TINY, one_model, scene_file


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


@pytest.mark.mpi(1)
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


@pytest.mark.mpi(2)
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


@pytest.mark.mpi(2)
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


@pytest.mark.mpi(2)
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


def test_a_memory_of_an_unfiltered_flow_has_eight_times_the_grid_points():
    """Frames of 32^3 tracers on 56^3 grid points; with memory on 112^3 unless the tracers are filtered."""
    def needs(method, filtered):
        scene = load_scene("hit-small", [f"reconstruction.method={method}", f"tracers.filtered={filtered}"],
                           ["kernel", "model", "training", "simulation", "variant"])
        return storage(scene, "reconstruct", 1).memory - TORCH_PROCESS

    assert needs("memory", "true") == needs("least-squares", "true") == needs("least-squares", "false")
    assert 4 < needs("memory", "false") / needs("memory", "true") <= 8  # less than 8, because of the particles


@pytest.mark.mpi(2)
def test_tracks_need_what_their_file_holds(comm, tmp_path):
    """A slab of measured tracks in a larger cube, half of them in all frames."""
    import numpy as np

    from eddies import write_tracks
    from eddies.workflows import tracks
    folder, draw = comm.bcast(tmp_path), np.random.default_rng(1)
    position = np.tile(draw.uniform(0.1, 0.9, (600, 3)) * [1, 1, 0.2], (10, 1)) + np.repeat(
        np.arange(10) * 0.001, 600)[:, None]
    track = np.concatenate([np.where(np.arange(600) < 300, np.arange(600), np.arange(600) + 600 * frame)
                            for frame in range(10)])
    if comm.rank == 0:
        write_tracks(folder / "a.h5", np.repeat(np.arange(10) * 0.1, 600), track, position,
                     np.full((6000, 3), 0.01) * draw.normal(1, 0.1, (6000, 3)))
        scene_file(folder, '[tracks]\npath = "a.h5"\nvolume = [0, 1, 0, 1, 0, 0.25]\nfield_every = 3\n')
    comm.Barrier()
    scene = tracks.with_tracks(load_scene(folder / "case.toml"), comm)
    measured, _ = measure([scene], comm)
    found = estimate(scene, measured)
    assert (found.tracks.mean_count, found.tracks.complete, found.frames) == (600, 300, 10)
    assert scene.tracers.particles > 3 * 600  # that many would fill the cube
    assert storage(scene, "dns", comm.size, measured).memory > storage(scene, "dns", 2 * comm.size, measured).memory
    tracks.run(scene, comm, folder)
    size = comm.bcast((folder / "ground_truth.h5").stat().st_size)
    assert storage(scene, "dns", comm.size, measured).kept == pytest.approx(size, rel=0.2)
    with h5py.File(folder / "ground_truth.h5") as file:
        assert file["tracks"].attrs["mean_count"] == found.tracks.mean_count


def test_the_disk_of_the_worst_moment():
    assert most_disk([Storage(0, 4.0, 2.0), Storage(0, None, 9.0), Storage(0, 3.0)]) == 13
    assert most_disk([Storage(0, 2.0)] * 3) == 6
    _, kept, scratch = storage(load_scene("taylor-green", ["flow.cells=256"]), "dns", 1)
    assert kept > 4 * 3 * 256**3 and scratch > 256**3


# ---- ranks


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("override, most", [
    ("kernel.neighbors=100", 3), ("kernel.neighbors=200", 2), ("simulation.skin=1", 2)])
def test_most_ranks_is_what_the_parts_accept(comm, override, most):
    from eddies.parallel.halo import HaloError, require_thick_slabs
    from eddies.parallel.slab import SlabDecomposition
    from eddies.scene.scene import BOX_LENGTH
    from eddies.spectral.interpolation import SplineInterpolation
    from eddies.spectral.spectral_grid import SpectralGrid
    scene = load_scene(TINY, [override])
    fields, particles = (SlabDecomposition(comm, BOX_LENGTH, planes)
                         for planes in (scene.tracers.cells, planes_for(scene.tracers.particles)))
    assert min(most_ranks(scene).values()) == most
    SplineInterpolation(SpectralGrid(fields), "quintic")
    SplineInterpolation(SpectralGrid(particles), "cubic")
    with nullcontext() if comm.size <= most else pytest.raises(HaloError):
        require_thick_slabs(fields, scene.tracers.radius_of(scene.kernel.neighbors))
        require_thick_slabs(particles, ModelDefinition.of(scene).radius * (1 + scene.simulation.skin))


def test_horizons_do_not_limit_the_ranks():
    """Particles change rank within a window. The loss of the energies needs the grid of the resolved velocity."""
    for preset in ("resolved + pairs", "transport-velocity"):
        plain, through = (most_ranks(load_scene(TINY, [f"model.preset={preset}", *more])) for more in (
            [], ["training.horizons.steps=5", "training.horizons.frames=[1, 12]"]))
        assert {name: ranks for name, ranks in through.items() if "ghost planes of the resolved" not in name} == (
            {name: ranks for name, ranks in plain.items() if "ghost planes of the resolved" not in name})
        assert through["ghost planes of the resolved velocity"] == 20 // 3


@pytest.mark.parametrize("overrides, planes", [([], 4), (["simulation.step=0.1"], 3),
                                               (["simulation.step=0.1", "time.courant=2.5"], 5)])
def test_a_coarse_grid_has_ghost_planes_for_its_courant_number(overrides, planes):
    """A search for the step begins with 1.4, the scene has 1."""
    scene = load_scene("hit-small", overrides).variant["grid-32"]
    assert most_ranks(scene)["ghost planes of the coarse grid"] == 32 // planes


def test_ghost_planes_limit_the_ranks():
    fields = {planes: most_ranks(load_scene(TINY, [f"tracers.field_cells={planes}"])) for planes in (11, 12)}
    assert [limits["ghost planes of the filtered fields"] for limits in fields.values()] == [2, 3]
    # A slab needs two ghost planes for the splines, and more for particles that moved by half the skin.
    assert fields[12]["ghost planes of the resolved velocity"] == 20 // 3
    for overrides, ghosts in ((["simulation.step=0.2"], 3), (["simulation.skin=1"], 4)):
        assert most_ranks(load_scene(TINY, overrides))["ghost planes of the resolved velocity"] == 20 // ghosts
    assert "ghost planes of the resolved velocity" not in most_ranks(load_scene(TINY, ["model.preset=paper"]))
    coarse = ["model.preset=paper", "simulation.method=eulerian", "eulerian.cells=24"]
    for first, most in (("flow", None), ("particles", 20 // 3)):
        limits = most_ranks(load_scene(TINY, [*coarse, f"eulerian.start={first}"]))
        assert limits.get("ghost planes of the resolved velocity") == most


def test_what_no_term_reads_limits_no_ranks():
    limits = {preset: most_ranks(load_scene(TINY, [f"model.preset={preset}"]))
              for preset in ("resolved + pairs", "resolved", "transport-velocity")}
    found = {preset: {word for word in ("reach", "resolved") if any(word in reason for reason in reasons)}
             for preset, reasons in limits.items()}
    assert found == {"resolved": {"resolved"}, "transport-velocity": {"reach"},
                     "resolved + pairs": {"reach", "resolved"}}
    for changes in ([], ["training.horizons.steps=5", "model.path=runs/other"]):
        limits = most_ranks(one_model("hit-small", changes))
        assert min(limits.values()) == 12 and not any("horizons" in reason for reason in limits)


def test_a_rollout_is_forced_like_its_truth_unless_it_has_a_power_of_its_own():
    found = [forces_rollout(load_scene(TINY, [f"tracers.forced={forced}", f"simulation.injection={power}"]))
             for forced, power in (("true", "truth"), ("false", "truth"), ("true", "none"), ("false", "0.5"))]
    assert found == [True, False, False, True]
