"""Measured tracks in the place of a direct simulation; here they are the tracers of one, so the truth is known."""

import json
import re
from dataclasses import replace

import h5py
import numpy as np
import pytest

from eddies import open_run, run, write_tracks
from eddies.io.errors import ProductError
from eddies.io.hdf5 import open_product
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import Stopped, StopRequest
from eddies.particles.error_samples import ErrorSamples
from eddies.scene.scene import SceneError, load_scene
from eddies.workflows import export, left_out_tracks, reconstruct, tracks
from eddies.workflows.diff import numbers_of
from eddies.workflows.ground_truth.track_frames import read_measured
from eddies.workflows.track_source import Source
from tests.commands import first_rank
from tests.workflows.small_rollout import prepared
from tests.workflows.stopping import StopAtStep

MILLIMETRES, MILLISECONDS = 20.0, 4.0  # edge of the box, and the time unit of the file in that of the flow
ARRAYS = {"pos": "position", "vel": "velocity", "rho": "density"}
SECTION = """[tracks]
path = "{path}"
box = 20.0
time_unit = {unit}
filtered = true
field_every = 2
"""


@pytest.fixture(scope="session")
def twin(comm, shared_folder):
    """A folder with the ground truth of a simulation with 10^3 tracers, and its tracers as a table without velocities.

    Rows are shuffled, lengths are in millimetres, and 20 particles are lost after half of the frames."""
    folder = shared_folder()
    prepared(comm, folder, overrides=["tracers.particles_per_side=10", "flow.cells=16", "tracers.field_cells=14"])
    if comm.rank == 0:
        with h5py.File(folder / "ground_truth.h5") as file:
            times, position = (file[f"particles/tracers/position/{name}"][()] for name in ("time", "value"))
        frames, count = position.shape[:2]
        rows = np.column_stack([np.tile(np.arange(count), frames), np.repeat(times / MILLISECONDS, count),
                                position.reshape(-1, 3) * MILLIMETRES / (2 * np.pi)])
        lost = (rows[:, 0] < 20) & (rows[:, 1] > rows[:, 1].mean())
        rows = np.random.default_rng(1).permutation(rows[~lost])
        np.savetxt(folder / "tracks.csv", rows, delimiter=",", header="track,time,x,y,z", comments="", fmt="%.15g")
    comm.Barrier()
    return folder


def scene_of(comm, folder, text, name="mine.toml"):
    first_rank(comm, (folder / name).write_text, text)
    return load_scene(folder / name)


def relative(found, true):
    """Normalised L2 error."""
    return np.linalg.norm(found - true) / np.linalg.norm(true)


@pytest.mark.mpi(2)
def test_a_ground_truth_of_tracks_is_that_of_the_flow(comm, twin, tmp_path):
    scene = tracks.with_tracks(scene_of(comm, tmp_path, SECTION.format(
        path=twin / "tracks.csv", unit=MILLISECONDS)), comm)
    tracks.run(scene, comm, tmp_path)
    with h5py.File(tmp_path / "ground_truth.h5") as own, h5py.File(twin / "ground_truth.h5") as true:
        assert own["particles/tracers/position/value"].shape[1] == own["tracks"].attrs["complete"] == 980
        assert own["tracks"].attrs["in_file"] == 1000 and 980 < scene.tracers.particles < 1000
        np.testing.assert_allclose(own["particles/tracers/position/time"], true["particles/tracers/position/time"])
        for name, error in (("position", 1e-6), ("velocity", 0.02)):
            place = f"particles/tracers/{name}/value"
            assert relative(own[place][()], true[place][:, 20:]) < error
        times = np.round(true["fields/filtered/time"][()], 9)
        for time, field in zip(own["fields/filtered/time"][()], own["fields/filtered/velocity"][()]):
            truth = true["fields/filtered/velocity"][int(np.flatnonzero(times == np.round(time, 9))[0])]
            assert relative(field, truth) < 0.1
        for name in ("acceleration_rms", "velocity_rms", "eddy_turnover_time"):
            assert own["reference"].attrs[name] == pytest.approx(true["reference"].attrs[name], rel=0.1)


def noisy(twin, path):
    """Write the tracks with noise to a table; returns the standard deviation of a coordinate."""
    rows = np.loadtxt(twin / "tracks.csv", delimiter=",", skiprows=1)
    noise = 0.005 * MILLIMETRES / 10  # a two-hundredth of the mean spacing, and half of a displacement
    rows[:, 2:] = (rows[:, 2:] + noise * np.random.default_rng(2).standard_normal(rows[:, 2:].shape)) % MILLIMETRES
    np.savetxt(path, rows, delimiter=",", header="track,time,x,y,z", comments="", fmt="%.15g")
    return noise


@pytest.mark.mpi(1)
def test_noise_costs_less_with_smoothing(comm, twin, tmp_path):
    noise = noisy(twin, tmp_path / "noisy.csv")
    with h5py.File(twin / "ground_truth.h5") as file:
        true = file["particles/tracers/velocity/value"][:, 20:]
    errors = {}
    for given in (0.0, noise):
        scene = scene_of(comm, tmp_path, SECTION.format(path="noisy.csv", unit=MILLISECONDS) + f"noise = {given}\n")
        found = read_measured(scene.tracks)
        velocity = np.stack([found.frame(frame, complete=True)["velocity"] for frame in range(len(found.times))])
        errors[given] = relative(velocity, true)
    assert errors[noise] < 0.2 < 0.4 * errors[0.0]


@pytest.mark.mpi(1)
def test_the_error_map_of_noisy_tracks_knows_their_splines(comm, twin, tmp_path, monkeypatch):
    made = []

    class Recorded(ErrorSamples):
        def __init__(self, *arguments):
            super().__init__(*arguments)
            made.append(self)

    monkeypatch.setattr(reconstruct, "ErrorSamples", Recorded)
    noise = noisy(twin, tmp_path / "noisy.csv")
    scene = scene_of(comm, tmp_path, SECTION.format(path="noisy.csv", unit=MILLISECONDS) + f"""noise = {noise}
viscosity = 0.01
[reconstruction]
method = "memory"
samples = 1
every = 2
holdout = 0
""")
    run(scene, stages=["dns", "reconstruct"], output=tmp_path / "run", comm=comm)
    weights = read_measured(scene.tracks).error_weights
    assert len(weights) > 3 and np.sum(weights**2) == pytest.approx(1)
    np.testing.assert_array_equal(made[0].weights, weights)
    assert made[0].every == 2


@pytest.mark.mpi(1)
def test_a_stopped_comparison_at_left_out_tracks_goes_on(comm, twin, tmp_path, monkeypatch):
    """Its floor is the error of the measured velocities in the frames that it compares. In the first and the last frame
    of the tracks, which are not compared, this error is three times as large."""
    noise, directory = noisy(twin, tmp_path / "noisy.csv"), tmp_path / "run"
    monkeypatch.setattr(left_out_tracks, "FRAMES", 4)
    text = SECTION.format(path="noisy.csv", unit=MILLISECONDS) + f"noise = {noise}\n[reconstruction]\n"
    scene = tracks.with_tracks(scene_of(comm, tmp_path, text + 'fields = ["velocity"]\n'), comm)
    run(scene, stages=["dns"], output=directory, comm=comm)
    found = read_measured(scene.tracks)
    with pytest.raises(Stopped, match="continues after the last frame"):
        reconstruct.run(scene, comm, directory, StopAtStep(comm, len(found.times) + 2))
    assert not (directory / "reconstruction.h5").exists()
    monkeypatch.setattr(reconstruct.ReconstructionRun, "_next", None)  # no frame is left
    reconstruct.run(scene, comm, directory)
    with h5py.File(directory / "reconstruction.h5") as file, h5py.File(twin / "ground_truth.h5") as true:
        assert len(file["fields/reconstructed/time"]) == len(found.times)
        floor, exact = file["left_out"].attrs["floor"], true["particles/tracers/velocity/value"]
        errors = [relative(found.frame(frame, complete=True)["velocity"], exact[frame, 20:]) for frame in (2, 3)]
    # The tracks that end in frame 3, which are not complete, add a quarter; all frames together have twice the error.
    assert floor == pytest.approx(np.mean(errors), rel=0.35)


@pytest.mark.mpi(1)
def test_methods_at_left_out_tracks_have_their_own_modes(comm, twin, tmp_path):
    """Whichever of them is the method of the scene; for tracks of the whole flow a memory has more modes."""
    section = SECTION.replace("true", "false").replace("every = 2", "every = 6")
    section = section.format(path=twin / "tracks.csv", unit=MILLISECONDS)
    text, found = f"{section}viscosity = {1e-3 * (MILLIMETRES / 6.28)**2}\n[reconstruction]\nevery = 3\n", {}
    for method in ("least-squares", "memory"):
        scene = tracks.with_tracks(scene_of(comm, tmp_path, f'{text}method = "{method}"\n'), comm)
        run(scene, stages=["dns"], output=tmp_path / "run", comm=comm)
        with open_product(comm, tmp_path / "run/ground_truth.h5", "ground_truth") as file:
            source = Source(scene.tracks, scene.tracers, scene.reconstruction, file, comm)
            found[method] = left_out_tracks.errors_at_left_out(scene, source, file, StopRequest(comm))
    assert found["memory"] == pytest.approx(found["least-squares"], rel=1e-3)


@pytest.mark.mpi(1)
@pytest.mark.filterwarnings("error")
def test_tracks_of_two_rows_are_refused(comm, tmp_path):
    position = np.random.default_rng(1).random((60, 3))
    write_tracks(tmp_path / "a.h5", np.repeat([0.0, 0.1, 0.2, 0.3], 15), np.repeat([0, 100], 30) + np.tile(
        np.arange(15), 4), position, edge=1.0)
    with pytest.raises(SceneError, match="have no track with three rows or more"):
        read_measured(scene_of(comm, tmp_path, '[tracks]\npath = "a.h5"\n').tracks)


@pytest.mark.mpi(1)
def test_times_become_equal_ones_and_a_gap_is_named(comm, tmp_path):
    """Times with the rounding of a table are snapped to frames, also where single tracks have other digits."""
    times = 0.1 + np.arange(7) / 300
    time, track = (part.ravel() for part in np.meshgrid(times, np.arange(30), indexing="ij"))
    draw = np.random.default_rng(1)
    position = draw.uniform(0, 6, (30, 3))[track] + np.outer(time, [0.1, 0.2, 0.3])
    given = np.where(track % 3, np.round(time, 5), time)
    write_tracks(tmp_path / "a.h5", given, track, position)
    scene = scene_of(comm, tmp_path, f'[tracks]\npath = "a.h5"\nbox = {2 * np.pi}\nlongest_gap = 0\n')
    found = read_measured(scene.tracks)
    np.testing.assert_allclose(found.times, np.arange(7) * 0.00333333, rtol=1e-5)
    assert found.complete == 30
    np.testing.assert_allclose(found.frame(2)["velocity"], np.tile([0.1, 0.2, 0.3], (30, 1)), rtol=0.05)
    write_tracks(tmp_path / "a.h5", time[time != times[3]], track[time != times[3]], position[time != times[3]])
    with pytest.raises(SceneError, match="no track is there at time 0.11 "):
        read_measured(scene.tracks)
    write_tracks(tmp_path / "a.h5", time + 1e-3 * (time == times[2]), track, position)
    with pytest.raises(SceneError, match="equal intervals are needed"):
        read_measured(scene.tracks)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("text, error, words", [
    (SECTION, ProductError, "missing.csv: no such file"),
    (SECTION.replace("20.0", "19.0"), ProductError, "outside the box from .* to .19"),
    (SECTION.replace("box = 20.0", ""), SceneError, "box: this key is missing"),
    (SECTION + "sound_speed = 5.0", SceneError, "has no densities"),
    (SECTION.replace("true", "false") + "sound_speed = 5.0\n[kernel]\nsteps = 1", SceneError,
     "the density of the unfiltered flow is no filtered density"),
    (SECTION + "[forcing]\ninjection_rate = 1", SceneError, "takes the place of this section"),
    ("realisations = [1]\n" + SECTION, SceneError, "the file has one realisation"),
    (SECTION + '[reconstruction]\nmethod = "memory"', SceneError, "viscosity: .* the method memory"),
    (SECTION + "[tracers]\ncount = 500\nturnovers = 1\nframe_interval = 1", SceneError, r"\[tracers\]: does not fit"),
    (SECTION + '[model]\npreset = "resolved"\n[training]\nframes = 2\nbatch = 10\nsteps = 1', SceneError,
     'viscosity: this key is missing, and the term "viscosity" needs it')],
    ids=["file", "outside", "box", "density", "filtered", "forcing", "realisations", "memory", "tracers", "viscosity"])
def test_tracks_that_do_not_fit_are_refused(comm, twin, tmp_path, text, error, words):
    path = "missing.csv" if "missing" in words and "file" in words else twin / "tracks.csv"
    with pytest.raises(error, match=words) as caught:
        tracks.with_tracks(scene_of(comm, tmp_path, text.format(path=path, unit=MILLISECONDS)), comm)
    assert "\n" not in str(caught.value)


@pytest.mark.mpi(1)
def test_layouts_of_the_scene_are_those_that_can_be_read():
    from eddies.io.track_files import LAYOUTS
    from eddies.scene.sections import Tracks
    assert Tracks.__dataclass_fields__["format"].metadata["rule"].words == tuple(LAYOUTS)


@pytest.mark.mpi(1)
def test_data_as_published_are_trained_on_end_to_end(comm, tmp_path, no_figures, quick_spectra):
    """16^3 particles in arrays pos, vel and rho, the published system, and the measures of Fig. 3. With densities the
    ground truth is compressible."""
    prepared(comm, tmp_path / "flow", overrides=[
        "tracers.particles_per_side=16", "flow.cells=24", "tracers.field_cells=24", "tracers.turnovers=0.2"])
    with h5py.File(tmp_path / "flow/ground_truth.h5") as file:
        np.savez(tmp_path / "published.npz", **{
            name: file[f"particles/tracers/{column}/value"][()] for name, column in ARRAYS.items()})
        true = dict(file["reference"].attrs)
    scene = scene_of(comm, tmp_path, f"""[tracks]
path = "published.npz"
frame_rate = 50.0
filtered = true
box = {2 * np.pi}
sound_speed = 15.0
field_every = 2
[model]
preset = "paper"
[training]
window = 0.6
frames = 2
batch = 500
steps = 60
learning_rate = 1e-2
""", "published.toml")
    run(scene, output=tmp_path / "run", comm=comm)
    with h5py.File(tmp_path / "run/ground_truth.h5") as file:
        found = dict(file["reference"].attrs)
    for name in ("density_rms", "density_rate_rms", "velocity_rms", "acceleration_rms", "mach_turbulent"):
        assert found[name] == pytest.approx(true[name], rel=0.05), name
    stored = open_run(tmp_path / "run")
    errors = stored["model/a_priori"]
    assert np.all(np.asarray(errors["acceleration_error"]) < 0.95)  # without a model it is 1
    assert np.asarray(errors["delay"])[-1] > 0
    shown = numbers_of(stored.path, None)["models"]["acceleration_error"]
    assert shown == pytest.approx(float(errors["acceleration_error"][-1]))


@pytest.mark.mpi(2)
def test_short_tracks_of_the_whole_flow_have_filtered_fields(comm, tmp_path, no_figures):
    """No track is there all the time, and all follow the whole flow; the filter is applied to the reconstruction."""
    prepared(comm, tmp_path / "flow", removals=["kernel", "model", "training", "simulation"], overrides=[
        "tracers.particles_per_side=14", "flow.cells=16", "tracers.field_cells=16", "tracers.filtered=false",
        "tracers.filter_width=1.2"])
    if comm.rank == 0:
        with h5py.File(tmp_path / "flow/ground_truth.h5") as file:
            times, position, velocity = (file[f"particles/tracers/{name}"][()] for name in (
                "position/time", "position/value", "velocity/value"))
        frame, particle = (part.ravel() for part in np.meshgrid(*map(np.arange, position.shape[:2]), indexing="ij"))
        there = (frame < len(times) - 1) ^ (particle % 2 == 0)
        write_tracks(tmp_path / "short.h5", times[frame[there]], particle[there].astype(np.int32),
                     position[frame, particle][there], velocity[frame, particle][there])
    run(scene_of(comm, tmp_path, '[tracks]\npath = "short.h5"\nfield_every = 2\nfilter_width = 1.2\n'
                                 '[reconstruction]\nevery = 2\nfields = ["velocity"]\n'), output=tmp_path / "run",
        comm=comm)
    with h5py.File(tmp_path / "run/reconstruction.h5") as own:
        assert 0 < np.mean(own["errors_over_time/validation_error"]) < 0.3
    with h5py.File(tmp_path / "run/ground_truth.h5") as own, h5py.File(tmp_path / "flow/ground_truth.h5") as true:
        assert "particles" not in own and own["tracks"].attrs["complete"] == 0
        field, truth = own["fields/filtered/velocity"][0], true["fields/filtered/velocity"][0]
        assert own["reference"].attrs["energy"] == pytest.approx(true["reference"].attrs["energy"], rel=0.15)
    assert relative(field, truth) < 0.1


@pytest.mark.mpi(2)
def test_a_model_learns_from_tracks_of_the_whole_flow(comm, tmp_path, no_figures, quick_spectra):
    """Particles follow the reconstructed filtered flow from the first tracks on, as the filtered tracers of the same
    simulation do. Half of the tracks end early."""
    prepared(comm, tmp_path / "flow", removals=["kernel", "model", "training", "simulation"], overrides=[
        "flow.cells=16", "tracers.field_cells=16", "tracers.particles_per_side=14", "tracers.whole.filtered=false",
        "tracers.smooth.filtered=true", "tracers.turnovers=0.4"])
    if comm.rank == 0:
        with h5py.File(tmp_path / "flow/whole/ground_truth.h5") as file:
            viscosity = file["reference"].attrs["viscosity"]
            times, position, velocity = (file[f"particles/tracers/{name}"][()] for name in (
                "position/time", "position/value", "velocity/value"))
        frame, particle = (part.ravel() for part in np.meshgrid(*map(np.arange, position.shape[:2]), indexing="ij"))
        there = (frame < len(times) // 2) | (particle % 2 == 0)
        write_tracks(tmp_path / "whole.h5", times[frame[there]], particle[there], position[frame, particle][there],
                     velocity[frame, particle][there])
        (tmp_path / "mine.toml").write_text(
            f'[tracks]\npath = "{tmp_path / "whole.h5"}"\nviscosity = {viscosity}\nfield_every = 2\n'
            '[model]\npreset = "resolved"\n[training]\nframes = 4\nbatch = 100\nsteps = 4\n'
            f'[simulation]\nframe_interval = {2 * (times[1] - times[0])}\nturnovers = 0.05\nstep = 0.05\n')
    comm.Barrier()
    run(tmp_path / "mine.toml", output=tmp_path / "run", comm=comm)
    metrics = numbers_of(tmp_path / "run", None)
    assert metrics["rollouts"]["status"] == "complete" and metrics["models"]["acceleration_error"] < 0.5
    with h5py.File(tmp_path / "run/ground_truth.h5") as own, h5py.File(
            tmp_path / "flow/smooth/ground_truth.h5") as true:
        found, exact = (file["particles/tracers/velocity/value"][()] for file in (own, true))
        assert found.shape == exact.shape and own["tracks"].attrs["complete"] == 14**3 // 2
        scales = [file["reference"].attrs["acceleration_rms"] for file in (own, true)]
    assert relative(found[5], exact[5]) < 0.05 and relative(found[6] - found[4], exact[6] - exact[4]) < 0.2
    assert scales[0] == pytest.approx(scales[1], rel=0.1)


class Vortices:
    """The steady flow of the stream function psi = cos x + cos z, which is constant along each path."""

    def psi(self, position):
        return np.cos(position[:, 0]) + np.cos(position[:, 2])

    def at(self, position):
        return np.column_stack([-np.sin(position[:, 2]), np.zeros(len(position)), np.sin(position[:, 0])])


@pytest.mark.mpi(2)
def test_filtered_tracers_have_the_second_order_of_heun(comm):
    flow, count = Vortices(), 60
    start = np.random.default_rng(3).uniform(0, 2 * np.pi, (count, 3))
    own = slice(comm.rank * count // comm.size, (comm.rank + 1) * count // comm.size)
    errors = []
    for steps in (40, 80):
        traced = tracks.FilteredTracers(SlabDecomposition(comm, 2 * np.pi, 8), {
            "id": np.arange(count)[own], "position": start[own]})
        traced.follow(flow, 0.0)
        for _ in range(steps):
            first, columns = traced.follow(flow, 4.0 / steps)
        rows = slice(first, first + len(columns["position"]))
        errors.append(comm.allreduce(np.sum((flow.psi(columns["position"]) - flow.psi(start[rows]))**2)) ** 0.5)
    assert 0 < errors[1] < errors[0] / 3.4  # second order has 4 or more, Euler's method 2
    assert errors[1] < 0.05


@pytest.mark.mpi(1)
def test_fields_of_tracks_have_the_units_of_the_file(comm, twin, tmp_path, no_figures, caplog):
    (tmp_path / "points.csv").write_text("x;y;z\n0;0;0\n10;0;5\n")
    scene = scene_of(comm, tmp_path, SECTION.format(path=twin / "tracks.csv", unit=MILLISECONDS) + f"""
viscosity = {0.1 * (MILLIMETRES / (2 * np.pi))**2}
density = 1000.0
[reconstruction]
method = "memory"
cells = 14
every = 2
fields = ["velocity", "acceleration", "pressure", "dissipation"]
points = "points.csv"
""")
    assert scene.stages == ("dns", "reconstruct", "report")
    caplog.set_level("DEBUG", "eddies")
    run(scene, output=tmp_path / "run", comm=comm)
    for words in ("tracks", *(f"{name} for left-out tracks" for name in ("least-squares", "memory", "neighbours"))):
        assert re.search(rf"frame \d+  {words}  .* left$", caplog.text, re.MULTILINE)
    stored = open_run(tmp_path / "run")
    numbers = stored.metrics["reconstruction"]
    assert 0 < numbers["validation_error"] < 0.2
    errors = [numbers[f"left_out_{name}"] for name in ("memory", "least-squares", "kriging", "delaunay")]
    assert 0 < errors[0] and max(errors[:2]) < min(errors[2:]) and max(errors) < 0.8
    assert numbers["spacing_over_eta"] > 1 and 0 < numbers["dissipation_share"] < 1
    field = np.asarray(stored.field(of="reconstructed"))
    with h5py.File(tmp_path / "run/reconstruction.h5") as own, h5py.File(twin / "ground_truth.h5") as true:
        time = own["fields/reconstructed/time"][-1]
        frame = int(np.argmin(np.abs(true["fields/filtered/time"][()] - time)))
        assert relative(field, true["fields/filtered/velocity"][frame] * MILLIMETRES / (2 * np.pi)) < 0.15
        fields = own["fields/reconstructed"]
        assert fields["pressure"].attrs["units"].decode() == "M/(L T^2)"
        assert fields["dissipation"].attrs["share"] == pytest.approx(numbers["dissipation_share"])
        # The rms of the kinematic pressure is about u'^2.
        assert 300 < np.std(fields["pressure"]) / np.mean(fields["velocity"][()]**2) < 3000
        np.testing.assert_allclose(own["particles/points/coordinates/value"][0], [[0, 0, 0], [10, 0, 5]], atol=1e-9)
        acceleration, time = (own[f"fields/reconstructed/{name}"][-2] for name in ("acceleration", "time"))
        tracers, times = true["particles/tracers/velocity/value"], true["particles/tracers/position/time"][()]
        frame = int(np.argmin(np.abs(times - time)))
        rates = (tracers[frame + 1] - tracers[frame - 1]) / (times[frame + 1] - times[frame - 1])
        assert np.std(acceleration) == pytest.approx(np.std(rates) * MILLIMETRES / (2 * np.pi), rel=0.1)
    caplog.set_level("INFO", "eddies")
    export.run(tmp_path / "run", tmp_path / "vtk", comm)
    assert "particles-points is left out: its rows may be others in each frame" in caplog.text
    with h5py.File(tmp_path / "vtk/reconstruction-fields-reconstructed.vtkhdf") as file:
        np.testing.assert_allclose(file["VTKHDF"].attrs["Spacing"], MILLIMETRES / 14)


@pytest.mark.mpi(1)
def test_a_volume_that_is_not_periodic(comm, twin, tmp_path, no_figures):
    """Tracks within the inner box of 0.7 edges of the cube, with other coordinates; the field is right inside."""
    lower, upper = 0.15 * MILLIMETRES, 0.85 * MILLIMETRES
    rows = np.loadtxt(twin / "tracks.csv", delimiter=",", skiprows=1)
    rows = rows[((rows[:, 2:] > lower) & (rows[:, 2:] < upper)).all(1) & (rows[:, 1] < np.unique(rows[:, 1])[6])]
    rows[:, 2:] -= lower
    np.savetxt(tmp_path / "inner.csv", rows, delimiter=",", header="track,time,x,y,z", comments="", fmt="%.15g")
    side = upper - lower
    scene = scene_of(comm, tmp_path, f"""[tracks]
path = "inner.csv"
volume = [0, {side}, 0, {side}, 0, {side}]
time_unit = {MILLISECONDS}
filtered = true
filter_width = {0.2 * MILLIMETRES}
field_every = 3
[reconstruction]
method = "least-squares"
cells = 20
fields = ["velocity", "gradient"]
every = 3
particles = true
""")
    run(scene, output=tmp_path / "run", comm=comm)
    if comm.rank:
        return
    with h5py.File(tmp_path / "run/reconstruction.h5") as own, h5py.File(twin / "ground_truth.h5") as true:
        about = dict(own["about"].attrs)
        assert 2 * np.pi * about["length_unit"] > side  # with a margin
        left_out = dict(own["left_out"].attrs)
        assert set(left_out) == {"tracks", "least-squares", "kriging", "delaunay"}  # a memory needs the viscosity
        # Those beyond the outermost tracks are in no tetrahedron.
        assert 5 < left_out.pop("tracks") < 40 and max(left_out.values()) < 1
        table = own["particles/tracks"]
        frame = 3
        ids, position, velocity = (table[f"{name}/value"][-1] for name in ("track", "coordinates", "velocity"))
        there, ids = ids >= 0, ids.astype(int)
        assert 200 < there.sum() < 400 and (position[there] >= 0).all() and (position[there] <= side).all()
        tracers = true["particles/tracers/velocity/value"][frame][ids[there]] * MILLIMETRES / (2 * np.pi)
        assert relative(velocity[there], tracers) < 0.15
        assert table["gradient/value"].shape[2:] == (9,)
        # The plane z in the middle of the volume, away from its faces.
        points = (np.arange(20) / 20 * 2 * np.pi * about["length_unit"] - about["corner"][0])
        inner = np.flatnonzero((points > 0.1 * side) & (points < 0.9 * side))
        field = own["fields/reconstructed/velocity"][-1][:, inner][:, :, inner][:, :, :, inner]
        whole = true["fields/filtered/velocity"][frame] * MILLIMETRES / (2 * np.pi)
    exact = at_points(whole, np.stack(np.meshgrid(*[points[inner] + lower] * 3, indexing="ij"), -1))
    assert relative(field, exact) < 0.2


@pytest.mark.mpi(1)
@pytest.mark.parametrize("method", ["least-squares", "kriging"])
def test_eight_tracks_in_a_box_have_fields(comm, tmp_path, no_figures, method):
    """The ball that holds the neighbours of a kernel would be larger than the box."""
    times, start = 0.01 * np.arange(4), np.random.default_rng(1).random((8, 3))
    position = start + np.multiply.outer(times, np.sin(2 * np.pi * start[:, [1, 2, 0]]))
    write_tracks(tmp_path / "few.h5", np.repeat(times, 8), np.tile(np.arange(8), 4), position.reshape(-1, 3) % 1,
                 edge=1.0)
    run(scene_of(comm, tmp_path, f'[tracks]\npath = "few.h5"\n[reconstruction]\nmethod = "{method}"\n'
                                 'fields = ["velocity"]\n'), output=tmp_path / "run", comm=comm)
    with h5py.File(tmp_path / "run/reconstruction.h5") as file:
        assert 0 < np.abs(file["fields/reconstructed/velocity"][()]).max() < 3  # velocities are at most 1


class RandomFlow:
    """A solenoidal velocity of random waves; the rms of a component is about one."""

    def __init__(self, seed):
        draw = np.random.default_rng(seed)
        directions = draw.standard_normal((60, 3))
        self.waves = directions / np.linalg.norm(directions, axis=1)[:, None] * draw.uniform(1, 4, (60, 1))
        across = np.cross(self.waves, draw.standard_normal((60, 3)))
        self.speeds = across / np.linalg.norm(across, axis=1)[:, None] * np.sqrt(6 / 60)
        self.phases = draw.uniform(0, 2 * np.pi, 60)

    def at(self, position):
        return np.cos(position @ self.waves.T + self.phases) @ self.speeds

    def gradient(self, position):
        return np.einsum("nw,wi,wj->nij", -np.sin(position @ self.waves.T + self.phases), self.speeds, self.waves)


@pytest.mark.mpi(1)
def test_a_mean_flow_and_shear_change_no_error(comm, tmp_path, no_figures):
    """Tracks in a volume of turbulence, with and without a wind of 20 u' and a shear of 20 u' from face to face."""
    flow, slope = RandomFlow(1), np.array([[1.0, 5.0, 0.0], [0.5, -1.5, 2.0], [0.0, 1.0, 0.5]])
    middle, wind, count = np.array([3.0, 2.0, 2.0]), np.array([20.0, 1.0, 0.0]), 400
    start, errors, fields = middle + np.random.default_rng(2).uniform(-2, 2, (count, 3)), [], []
    times = 1e-6 * np.arange(3)  # so short that all have the same positions
    for moves in (0, 1):
        velocity = flow.at(start) + moves * (wind + (start - middle) @ slope.T)
        write_tracks(tmp_path / "a.h5", np.repeat(times, count), np.tile(np.arange(count), 3),
                     np.concatenate([start + time * velocity for time in times]), np.tile(velocity, (3, 1)))
        folder = tmp_path / str(moves)
        run(scene_of(comm, tmp_path, """[tracks]
path = "a.h5"
volume = [0.99, 5.01, -0.01, 4.01, -0.01, 4.01]
background = "linear"
viscosity = 1e-3
[reconstruction]
fields = ["velocity", "gradient"]
cells = 24
every = 3
particles = true
"""), output=folder, comm=comm)
        with h5py.File(folder / "reconstruction.h5") as file, h5py.File(folder / "ground_truth.h5") as truth:
            about, tracks_of = dict(file["about"].attrs), dict(truth["tracks"].attrs)
            assert "memory" not in file["left_out"].attrs  # its forecasts have no mean shear
            made = {key: file[f"fields/reconstructed/{key}"][0].astype(float) for key in ("velocity", "gradient")}
            found = [file["particles/tracks/velocity/value"][0],
                     truth["particles/tracers/velocity/value"][0] * about["length_unit"]]
        field = open_run(folder).field(of="reconstructed")
        points = [field[axis].values for axis in "xyz"]  # in the coordinates and the unit of the file
        place = np.stack(np.meshgrid(*points, indexing="ij"), -1).T  # (3, z, y, x)
        inner = (np.abs(place - middle[:, None, None, None]) < 1.2).all(0)
        place = place[:, inner].T
        mean, turbulent, slopes = (moves * (wind + (place - middle) @ slope.T), flow.at(place), flow.gradient(place))
        fields.append(made["velocity"][:, inner].T - mean)
        errors.append([
            relative(fields[-1], turbulent), relative(made["gradient"][:, inner].T - (moves * slope).ravel(),
                                                      slopes.reshape(-1, 9)),
            np.linalg.norm(found[0] - velocity) / np.linalg.norm(flow.at(start)), tracks_of["validation_error"]])
        np.testing.assert_allclose(found[1], velocity, atol=1e-5)  # the ground truth has the background too
        # The mean of the turbulence over the volume, and its slope, are a part of the background.
        assert np.abs(tracks_of["background_velocity"] - moves * wind).max() < 0.5
        assert np.abs(tracks_of["background_gradient"] - moves * slope).max() < 0.5
    # Displacements and the rounding of stored fields change the tracks by 1e-5.
    np.testing.assert_allclose(errors[1], errors[0], rtol=1e-2)
    assert relative(fields[1], fields[0]) < 1e-3
    assert errors[0][0] < 0.3 and errors[0][2] < 0.1


@pytest.mark.mpi(1)
@pytest.mark.parametrize("keys, words", [
    ("box = 7.0", "background = .linear.: a periodic box has no mean shear"),
    ('volume = "auto"\nviscosity = 0.1\n[reconstruction]\nmethod = "memory"',
     "background = .linear.: forecasts of the method .memory. have no mean shear")])
def test_a_background_without_a_volume_or_with_a_memory_is_refused(comm, tmp_path, keys, words):
    with pytest.raises(SceneError, match=words):
        tracks.with_tracks(scene_of(comm, tmp_path, '[tracks]\npath = "a.h5"\nbackground = "linear"\n' + keys), comm)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("thickness, volume, fits", [(2e-5, "[0, 1, 0, 1, 0, 2e-5]", False), (2e-5, '"auto"', False),
                                                     (0.018, "[0, 1, 0, 1, 0, 0.018]", True)])
def test_a_volume_thinner_than_half_a_spacing_is_refused(comm, tmp_path, thickness, volume, fits):
    """400 tracks in a sheet are 0.05 apart. A volume of 0.018 has a mean spacing of 0.036, so with margins of four
    spacings the cube has an edge of 1.14, and seven periods of 0.163 along z."""
    if comm.rank == 0:
        start = np.random.default_rng(1).random((400, 3)) * [1, 1, thickness]
        write_tracks(tmp_path / "flat.h5", np.repeat([0.0, 1.0, 2.0], 400), np.tile(np.arange(400), 3),
                     np.tile(start, (3, 1)), np.random.default_rng(2).standard_normal((1200, 3)) * 1e-16, edge=2.0)
    scene = scene_of(comm, tmp_path, f'[tracks]\npath = "flat.h5"\nvolume = {volume}\n')
    if fits:
        assert tracks.with_tracks(scene, comm).tracers.spacing < 0.036 * 2 * np.pi
        assert [*read_measured(scene.tracks).about["periods"]] == [1, 1, 7]
        assert [*read_measured(replace(scene.tracks, filtered=True)).about["periods"]] == [1, 1, 1]
        return
    with pytest.raises(SceneError, match="volume: .*flat.h5: it is .*e-05 thick along z, .* least 0.018 thick"):
        tracks.with_tracks(scene, comm)


@pytest.mark.mpi(1)
def test_a_volume_has_no_images(comm, tmp_path):
    """A particle that moves by more than half of the cube, to and fro: x = 0.1 + 0.7 (2 t - t^2) at t = 0, 1, 2."""
    write_tracks(tmp_path / "a.h5", [0, 1, 2], [0, 0, 0], [[0.1, 0.5, 0.5], [0.8, 0.5, 0.5], [0.1, 0.5, 0.5]])
    found = read_measured(scene_of(comm, tmp_path, '[tracks]\npath = "a.h5"\nvolume = [0, 1, 0, 1, 0, 1]\n'
                                                   'margin = 0.1\n').tracks)
    assert found.frame(0)["velocity"][0, 0] * found.about["length_unit"] == pytest.approx(1.4, rel=1e-3)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("wind, given, method", [
    ((1.0, 0.5, -0.2), False, "memory"), ((0.0, 0.0, 0.0), True, "least-squares")])
def test_tracks_that_move_alike_have_a_uniform_field_and_no_relative_error(comm, tmp_path, no_figures, caplog, wind,
                                                                           given, method):
    """A model could learn nothing from them."""
    times, start = 0.01 * np.arange(5), np.random.default_rng(1).random((100, 3))
    position = start + np.multiply.outer(times, wind)[:, None]
    velocity = np.broadcast_to(wind, position.shape).reshape(-1, 3) if given else None
    write_tracks(tmp_path / "uniform.h5", np.repeat(times, 100), np.tile(np.arange(100), 5),
                 position.reshape(-1, 3) % 1, velocity, edge=1.0)
    section = '[tracks]\npath = "uniform.h5"\nviscosity = 1e-3\n'
    with pytest.raises(SceneError, match="uniform.h5: all tracks move alike"):
        tracks.with_tracks(scene_of(comm, tmp_path, section + '[model]\npreset = "resolved"\n[training]\nframes = 2\n'
                                    "batch = 10\nsteps = 1\n"), comm)
    scene = scene_of(comm, tmp_path, f"""{section}[reconstruction]
method = "{method}"
fields = ["velocity", "gradient"]
samples = {0 if method == "kriging" else 1}
""")
    run(scene, output=tmp_path / "run", comm=comm)
    if comm.rank:
        return
    assert sum("all tracks move alike: the velocity field is uniform" in line for line in caplog.messages) == 1
    assert not [line for line in caplog.messages if "not finite" in line]
    with h5py.File(tmp_path / "run/reconstruction.h5") as file:
        field = file["fields/reconstructed/velocity"][()]
        assert np.abs(field - np.reshape(wind, (3, 1, 1, 1))).max() < 1e-7  # stored in single precision
        assert np.abs(file["fields/reconstructed/gradient"][()]).max() == 0
        assert "validation_error" not in file["errors_over_time"] and file["about"].attrs["holdout"] == 0
    with h5py.File(tmp_path / "run/ground_truth.h5") as file:
        assert file["reference"].attrs["energy"] == 0 and "validation_error" not in file["tracks"].attrs
    metrics = json.loads((tmp_path / "run/report/metrics.json").read_text())
    assert metrics["reconstruction"]["validation_error"] is None


@pytest.mark.mpi(1)
@pytest.mark.parametrize("factor, rows, words", [
    (0.5, 30, "show more noise, 0.00"), (1.0, 30, None), (1e3, 30, "show less noise: the residuals of a parabola"),
    (1.0, 3, "all tracks have three rows")])
def test_a_noise_that_does_not_fit_gives_a_warning(comm, tmp_path, caplog, factor, rows, words):
    draw, noise = np.random.default_rng(1), 1e-3
    times = 0.01 * np.arange(rows)
    swing = 0.2 * np.sin(8 * times[:, None] + 6 * draw.random(100))
    position = 0.3 + 0.4 * draw.random((100, 3)) + swing[:, :, None]
    write_tracks(tmp_path / "a.h5", np.repeat(times, 100), np.tile(np.arange(100), rows),
                 (position + noise * draw.standard_normal(position.shape)).reshape(-1, 3), edge=1.0)
    found = read_measured(scene_of(comm, tmp_path, f'[tracks]\npath = "a.h5"\nnoise = {factor * noise}\n').tracks)
    assert found.about["noise"] == pytest.approx(max(factor, 1) * noise, rel=0.1)  # the one that is used
    assert [words in line for line in caplog.messages if "noise = " in line] == ([True] if words else [])


@pytest.mark.mpi(1)
def test_a_steady_flow_without_acceleration_has_fields(comm, tmp_path):
    """Velocities of a shear flow are constant along paths."""
    times, start = 0.01 * np.arange(4), np.random.default_rng(1).random((300, 3))
    velocity = np.column_stack([np.zeros(300), np.sin(2 * np.pi * start[:, 0]), np.zeros(300)])
    position = start + np.multiply.outer(times, velocity)
    write_tracks(tmp_path / "steady.h5", np.repeat(times, 300), np.tile(np.arange(300), 4),
                 position.reshape(-1, 3) % 1, np.tile(velocity, (4, 1)), edge=1.0)
    scene = tracks.with_tracks(scene_of(comm, tmp_path, '[tracks]\npath = "steady.h5"\nfield_every = 1\n'), comm)
    tracks.run(scene, comm, tmp_path)
    with h5py.File(tmp_path / "ground_truth.h5") as file:
        assert file["reference"].attrs["acceleration_rms"] == 0
        assert file["tracks"].attrs["validation_error"] < 0.1
        # The filter of twice the spacing, 0.30, lowers a wave of length 1 by exp(-(2 pi 0.30)^2 / 24).
        field = file["fields/filtered/velocity"][0, 1] / (2 * np.pi)
    assert np.sqrt(2) * field.std() == pytest.approx(np.exp(-(4 * np.pi * 300 ** (-1 / 3)) ** 2 / 24), abs=0.01)
    assert abs(field.mean()) < 1e-3  # the mean over the tracks is 0.04


def at_points(field, places):
    """A field (3, z, y, x) on the cube of edge MILLIMETRES at points [z, y, x], by its Fourier series."""
    modes, cells = np.fft.fftn(field, axes=(1, 2, 3)) / field[0].size, field.shape[1]
    waves = np.exp(2j * np.pi / MILLIMETRES * np.multiply.outer(places[:, 0, 0, 0], np.fft.fftfreq(cells, 1 / cells)))
    return np.einsum("czyx,iz,jy,kx->cijk", modes, waves, waves, waves).real
