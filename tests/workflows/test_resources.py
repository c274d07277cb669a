"""Memory, disk and ranks of a scene: against what is allocated and stored, and what the parts of a run accept."""

import tracemalloc
from contextlib import nullcontext

import h5py
import pytest

from eddies.clock import Clock
from eddies.particles.flow_units import planes_for
from eddies.scene.scene import load_scene
from eddies.workflows.estimates import estimate, measure
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.resources import (FLOW_PROCESS, TORCH_PROCESS, Storage, flow_memory, forces_rollout, most_disk,
                                        most_ranks, storage)
from tests.small_scene import TINY, one_model, scene_file


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


def test_a_memory_of_an_unfiltered_flow_has_eight_times_the_grid_points():
    """Frames of 32^3 tracers on 56^3 grid points; with memory on 112^3 unless the tracers are filtered."""
    def needs(method, filtered):
        scene = load_scene("hit-small", [f"reconstruction.method={method}", f"tracers.filtered={filtered}"],
                           ["kernel", "model", "training", "simulation", "variant"])
        return storage(scene, "reconstruct", 1).memory - TORCH_PROCESS

    assert needs("memory", "true") == needs("least-squares", "true") == needs("least-squares", "false")
    assert 4 < needs("memory", "false") / needs("memory", "true") <= 8  # less than 8, because of the particles


@pytest.mark.mpi(1, 2)
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
    assert (found.tracks.in_frame, found.tracks.complete, found.frames) == (600, 300, 10)
    assert scene.tracers.particles > 3 * 600  # that many would fill the cube
    assert storage(scene, "dns", comm.size, measured).memory > storage(scene, "dns", 2 * comm.size, measured).memory
    tracks.run(scene, comm, folder)
    size = comm.bcast((folder / "ground_truth.h5").stat().st_size)
    assert storage(scene, "dns", comm.size, measured).kept == pytest.approx(size, rel=0.2)
    with h5py.File(folder / "ground_truth.h5") as file:
        assert file["tracks"].attrs["mean_count"] == found.tracks.in_frame


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
