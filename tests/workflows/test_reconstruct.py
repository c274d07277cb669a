"""Fields from tracks: exact derivatives of a known flow, errors that are estimated well, and methods."""

from dataclasses import replace

import h5py
import numpy as np
import pytest
import torch

from eddies.analysis.linear_flow import LinearFlow
from eddies.errors import UserError
from eddies.io import new_files
from eddies.io.errors import WriteError
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import Stopped
from eddies.particles.fourier_grid import FourierGrid
from eddies.scene.scene import Reconstruction
from eddies.scene.sections import RECONSTRUCTED
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.workflows import reconstruct
from tests.full_disk import largest_file
from tests.workflows.small_rollout import prepared
from tests.workflows.stopping import StopAtStep

# The largest error of each; the flow has most of its energy near the filter.
METHODS = {"least-squares": 0.1, "memory": 0.1, "kriging": 0.1, "average": 0.35}


@pytest.mark.mpi(2)
def test_quantities_of_a_taylor_green_vortex_are_exact(comm):
    """u = (sin x cos y, -cos x sin y, 0) + U with p = (cos 2x + cos 2y)/4, in another unit of length."""
    grid = FourierGrid(SlabDecomposition(comm, 2 * np.pi, 16), 5, 1)
    target = SpectralGrid(SlabDecomposition(comm, 2 * np.pi, 12), cutoff=5)

    def points(slab):
        axis = np.arange(slab.planes) * slab.spacing
        z, y, x = np.meshgrid(axis[slab.start:slab.stop], axis, axis, indexing="ij")
        return x, y, z

    x, y, z = points(grid.decomposition)
    field = np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0 * z])
    mean, unit, viscosity = np.array([0.5, 0.0, -1.0]), 3.0, 0.1
    modes = grid.with_mean(grid.to_modes(torch.from_numpy(field)), torch.from_numpy(mean))
    made = reconstruct.Quantities(modes, grid, tuple(RECONSTRUCTED), reconstruct.Medium(
        torch.ones_like(grid.shell), viscosity, unit))
    for name, values in exact_of(*points(target.decomposition), mean, unit, viscosity).items():
        np.testing.assert_allclose(made.on(target)[name], values, atol=1e-12, err_msg=name)
    # The filter acts on the velocity with k^2 = 2 and on its pressure with k = 2.
    width = 1.2
    transfer = grid.filter_transfer(width)
    filtered = reconstruct.Quantities(transfer * modes, grid, ("pressure",),
                                      reconstruct.Medium(transfer, viscosity, unit))
    exact = exact_of(*points(target.decomposition), mean, unit, viscosity)["pressure"]
    np.testing.assert_allclose(filtered.on(target)["pressure"], np.exp(-(2 * width) ** 2 / 24) * exact, atol=1e-12)
    slab = grid.decomposition
    position = np.random.default_rng(comm.rank).uniform(0, 2 * np.pi, (20, 3))
    position[:, 2] = slab.spacing * (slab.start + slab.count * position[:, 2] / (2 * np.pi))
    points = grid.points(torch.from_numpy(position))
    for name, values in exact_of(*position.T, mean, unit, viscosity).items():
        # Cubic splines through 16 points: errors of fourth order of waves with k = 2.
        np.testing.assert_allclose(made.at(points, position)[name].T, values, atol=0.05, err_msg=name)


def exact_of(x, y, z, mean, unit, viscosity):
    """The quantities (components, ...) of the vortex at points."""
    sx, cx, sy, cy, zero = np.sin(x), np.cos(x), np.sin(y), np.cos(y), 0 * z
    slope = np.zeros((3, 3, *x.shape))
    slope[0, 0], slope[0, 1], slope[1, 0], slope[1, 1] = cx * cy, -sx * sy, sx * sy, -cx * cy
    drift = mean.reshape(3, *[1] * x.ndim)
    return {"velocity": unit * (np.stack([sx * cy, -cx * sy, zero]) + drift),
            "gradient": slope.reshape(9, *x.shape),
            "strain": np.stack([cx * cy, -cx * cy, zero, zero, zero, zero]),
            "dissipation": unit**2 * 4 * viscosity * (cx * cy)[None] ** 2,
            "vorticity": np.stack([zero, zero, 2 * sx * sy]),
            "q": (-(cx * cy) ** 2 + (sx * sy) ** 2)[None], "r": zero[None],
            "pressure": unit**2 * (np.cos(2 * x) + np.cos(2 * y))[None] / 4,
            "acceleration": unit * np.stack([sx * cx - 2 * viscosity * sx * cy, sy * cy + 2 * viscosity * cx * sy,
                                             zero])}


@pytest.mark.mpi(1)
def test_quantities_beside_a_mean_flow_are_exact(comm):
    """u = T (0, cos x, 0) is the filtered u* with T = exp(-s^2 / 2), in W = V + (e x' + S y', -e y', 0), where x' is
    counted from the centre. W.grad u* has the component -e x' sin x, whose filtered value is -e T (x' sin x +
    s^2 cos x). So the filter gives the acceleration e s^2 T cos x, and the pressure p of 2 S d_x u_y is -2 S T sin x.
    """
    grid = FourierGrid(SlabDecomposition(comm, 2 * np.pi, 16), 5, 1)
    target = SpectralGrid(SlabDecomposition(comm, 2 * np.pi, 12), cutoff=5)
    slope, variance, viscosity, unit = np.array([[0.5, 2.0, 0], [0, -0.5, 0], [0, 0, 0]]), 0.1, 0.1, 3.0
    (e, shear), damped = slope[0, :2], np.exp(-0.1 / 2)
    mean, drift = LinearFlow(np.full(3, np.pi), np.array([20.0, 0, 1.0]), slope), np.array([0.0, 0.5, 0.0])
    transfer = grid.filter_transfer(np.sqrt(12 * variance))
    wave = np.cos(np.broadcast_to(grid.spectral.coordinates()[0], grid.spectral.physical_shape))
    modes = transfer * grid.to_modes(torch.from_numpy(np.stack([0 * wave, wave, 0 * wave])))
    made = reconstruct.Quantities(grid.with_mean(modes, torch.from_numpy(drift)), grid, tuple(RECONSTRUCTED),
                                  reconstruct.Medium(transfer, viscosity, unit, mean)).on(target)
    x, y, z = np.broadcast_arrays(*target.coordinates())
    whole = LinearFlow(mean.center, mean.velocity + drift, slope)
    velocity, pressure, acceleration = (make(x, y, z) for make in (whole.at, whole.pressure, whole.acceleration))
    velocity[1] += damped * np.cos(x)
    pressure -= 2 * shear * damped * np.sin(x)
    acceleration[0] += 2 * shear * damped * np.cos(x)
    acceleration[1] += (e * variance - viscosity) * damped * np.cos(x)
    turning = -damped * np.sin(x)  # du_y / dx
    for name, values in {"velocity": unit * velocity, "pressure": unit**2 * pressure,
                         "acceleration": unit * acceleration}.items():
        np.testing.assert_allclose(made[name], values, atol=1e-10, err_msg=name)
    np.testing.assert_allclose(made["gradient"][3], turning, atol=1e-12)
    np.testing.assert_allclose(made["gradient"][[0, 1]], np.broadcast_to(slope[0, :2, None, None, None], (2, *x.shape)),
                               atol=1e-12)
    np.testing.assert_allclose(made["vorticity"][2], turning - shear, atol=1e-12)
    np.testing.assert_allclose(made["dissipation"][0], unit**2 * 2 * viscosity * (
        2 * e**2 + (shear + turning) ** 2 / 2), atol=1e-10)
    np.testing.assert_allclose(made["q"][0], -e**2 - shear * turning, atol=1e-10)


@pytest.mark.mpi(1)
def test_a_pressure_has_the_density_and_a_dissipation_what_the_modes_lack(comm):
    """The share that the modes lack is that of their own strain, not of the mean flow."""
    grid = FourierGrid(SlabDecomposition(comm, 2 * np.pi, 12), 4, 1)
    target = SpectralGrid(grid.decomposition, cutoff=5)
    x, y, z = np.broadcast_arrays(*target.coordinates())
    modes = grid.to_modes(torch.from_numpy(np.stack([np.sin(x) * np.cos(y), -np.cos(x) * np.sin(y), 0 * z])))
    shear = LinearFlow(np.full(3, np.pi), np.zeros(3), np.array([[0.0, 3.0, 0], [0, 0, 0], [0, 0, 0]]))
    medium = reconstruct.Medium(torch.ones_like(grid.shell), 0.1)

    def made(name, **changes):
        return reconstruct.Quantities(modes, grid, (name,), replace(medium, **changes)).on(target)[name]

    np.testing.assert_allclose(made("pressure", density=1000.0), 1000 * made("pressure"), rtol=1e-12)
    own = made("dissipation")
    np.testing.assert_allclose(made("dissipation", share=0.4), own / 0.4, rtol=1e-10)
    np.testing.assert_allclose(made("dissipation", share=0.4, background=shear) - own / 0.4,
                               made("dissipation", background=shear) - own, atol=1e-12)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("timed", [False, True])
def test_quantities_at_given_points_are_those_of_the_field(comm, flow, tmp_path, linked, timed):
    """Points of the grid, and their periodic images; with times each is in the nearest frame."""
    (scene, folder), draw, edge = flow, np.random.default_rng(5), 2 * np.pi
    linked(folder)
    with h5py.File(folder / "ground_truth.h5") as file:
        times = file["particles/tracers/position/time"][::3]
    index, frame = draw.integers(0, 20, (30, 3)), draw.integers(0, len(times), 30)
    place = edge / 20 * index + edge * draw.integers(-1, 2, (30, 3))
    if comm.rank == 0:
        columns = np.column_stack([times[frame] + 0.01, place]) if timed else place
        np.savetxt(tmp_path / "points.csv", columns, delimiter=",", header="time,x,y,z" if timed else "x,y,z",
                   comments="")
    settings = Reconstruction(every=3, fields=("velocity", "q"), points=str(tmp_path / "points.csv"), holdout=0.0,
                              samples=2)
    comm.Barrier()
    reconstruct.run(replace(scene, reconstruction=settings), comm, tmp_path)
    with h5py.File(tmp_path / "reconstruction.h5") as file:
        table = {name: file[f"particles/points/{name}/value"][()] for name in (
            "row", "coordinates", "velocity", "velocity_deviation", "q")}
        field = {name: values[()] for name, values in file["fields/reconstructed"].items()}
    assert len(table["row"]) == len(times)
    for number in range(len(times)):
        rows = np.flatnonzero(frame == number) if timed else np.arange(30)
        there = slice(len(rows))
        np.testing.assert_array_equal(table["row"][number], [*rows, *[-1] * (table["row"].shape[1] - len(rows))])
        np.testing.assert_allclose(table["coordinates"][number, there], place[rows] % edge, atol=1e-9)
        for name, error in (("velocity", 0.01), ("velocity_deviation", 0.1), ("q", 0.05)):
            x, y, z = index[rows].T
            exact = field[name][number][:, z, y, x].T
            # Cubic splines on the grid of the modes, with 7/3 points in the shortest wave.
            assert np.abs(table[name][number, there] - exact).max() <= error * np.abs(field[name][number]).max()


@pytest.mark.mpi(2)
@pytest.mark.parametrize("text, words", [
    (None, "points.csv: cannot be read: No such file"),
    ("time,x,y,z\n0,1,1,1\n99,1,2,3\n", r"points.csv: .1, 2, 3, 99. is outside .* times from 0 to 0.*1 such")])
def test_points_that_cannot_be_used_are_refused_on_all_ranks(comm, flow, tmp_path, linked, text, words):
    scene, folder = flow
    linked(folder)
    if comm.rank == 0 and text:
        (tmp_path / "points.csv").write_text(text)
    comm.Barrier()
    settings = Reconstruction(every=3, fields=("velocity",), points=str(tmp_path / "points.csv"), holdout=0.0)
    with pytest.raises(UserError, match=words) as caught:
        reconstruct.run(replace(scene, reconstruction=settings), comm, tmp_path)
    assert "\n" not in str(caught.value) and not (tmp_path / "reconstruction.h5").exists()


@pytest.fixture(scope="session")
def flow(comm, shared_folder):
    """A scene and a folder with its ground truth: 14^3 tracers of the filtered flow, and fields."""
    folder = shared_folder()
    scene = prepared(comm, folder, removals=["model", "training", "simulation"], overrides=[
        "tracers.particles_per_side=14", "flow.cells=24", "tracers.field_cells=20", "tracers.turnovers=0.3"])
    return scene, folder


def errors_of(comm, flow, tmp_path, linked, **keys):
    """The errors of a reconstruction, by name, mean over time."""
    scene, folder = flow
    linked(folder)
    reconstruct.run(replace(scene, reconstruction=Reconstruction(**keys)), comm, tmp_path)
    with h5py.File(tmp_path / "reconstruction.h5") as file:
        errors = {name: float(np.mean(values[()])) for table in ("errors_over_time", "errors_of_fields")
                  for name, values in file[table].items()}
        return errors, {name: values.shape for name, values in file["fields/reconstructed"].items()}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("method", METHODS)
def test_validation_estimates_the_true_error(comm, flow, tmp_path, linked, method):
    errors, shapes = errors_of(comm, flow, tmp_path, linked, method=method, every=4, fields=("velocity", "q"))
    assert errors["velocity_error"] < METHODS[method]
    # Tracks that are left out have fewer neighbours, so their error is somewhat larger.
    assert 0.7 < errors["validation_error"] / errors["velocity_error"] < 1.6
    assert shapes["velocity"][1:] == (3, 20, 20, 20) and shapes["q"][1:] == (1, 20, 20, 20)


@pytest.mark.mpi(1)
def test_errors_have_standard_deviations(comm, tmp_path):
    """8^3 tracers of the filtered flow, on the grid of the true fields. The flow is too smooth for the prior, so only
    the size of the deviations is that of the errors; tests in `particles` are stricter."""
    scene = prepared(comm, tmp_path, fluid="incompressible", removals=["kernel", "model", "training", "simulation"],
                     overrides=["tracers.particles_per_side=8", "flow.cells=32", "tracers.field_cells=20",
                                "flow.viscosity=0.01", "tracers.turnovers=0.4", "tracers.frame_interval=0.2"])
    settings = Reconstruction(method="memory", fields=("velocity", "gradient"), holdout=0.0, samples=8, particles=True)
    reconstruct.run(replace(scene, reconstruction=settings), comm, tmp_path)
    with h5py.File(tmp_path / "reconstruction.h5") as file, h5py.File(tmp_path / "ground_truth.h5") as truth:
        made = {name: values[()] for name, values in file["fields/reconstructed"].items()}
        exact = truth["fields/filtered/velocity"][()].astype(float)
        tracks = {name: file[f"particles/tracks/{name}/value"][()] for name in ("velocity", "velocity_deviation")}
        at_tracks = truth["particles/tracers/velocity/value"][()]
        assert file["fields/reconstructed/gradient_deviation"].attrs["units"].decode() == "1/T"
    np.testing.assert_allclose(made["time"], 0.2 * np.arange(len(exact)), atol=1e-9)
    # Errors at the particles, which the fit minimises, are a twentieth of those between them.
    for found, name, true in ((made, "velocity", exact), (made, "gradient", gradient_of(exact)),
                              (tracks, "velocity", at_tracks)):
        ratio = np.linalg.norm(found[f"{name}_deviation"]) / np.linalg.norm(found[name] - true)
        assert 0.5 < ratio < 4, (name, ratio)


def gradient_of(velocity):
    """du_i/dx_j, row by row, of fields (frames, 3, z, y, x) on a grid of the cube."""
    cells = velocity.shape[-1]
    waves = np.fft.fftfreq(cells, 1 / cells) * (np.abs(np.fft.fftfreq(cells, 1 / cells)) < cells / 2)
    slopes = [np.fft.ifft(1j * waves.reshape(-1, *[1] * (4 - axis)) * np.fft.fft(velocity, axis=axis), axis=axis).real
              for axis in (4, 3, 2)]
    return np.stack(slopes, 2).reshape(len(velocity), 9, *velocity.shape[2:])


@pytest.mark.mpi(1)
def test_memory_finds_scales_of_an_unfiltered_flow_that_one_frame_does_not_determine(comm, tmp_path):
    """8^3 tracers resolve wavenumbers up to 6 in one frame; the flow has them up to 11."""
    scene = prepared(comm, tmp_path, removals=["kernel", "model", "training", "simulation"], overrides=[
        "tracers.particles_per_side=8", "tracers.filtered=false", "flow.cells=24", "flow.viscosity=0.02",
        "tracers.turnovers=0.8", "tracers.frame_interval=0.04"])
    errors, highest = {}, {}
    for method, every in (("least-squares", 8), ("memory", 1)):
        settings = Reconstruction(method=method, fields=("velocity",), holdout=0.0, every=every)
        reconstruct.run(replace(scene, reconstruction=settings), comm, tmp_path)
        with h5py.File(tmp_path / "reconstruction.h5") as file:
            errors[method] = file["errors_of_fields/velocity_error"][::8 // every][-1]
            highest[method] = file["about"].attrs["highest_wavenumber"]
    assert highest == {"least-squares": 6, "memory": 12}
    # Measured: 0.52.
    assert errors["memory"] < 0.6 * errors["least-squares"]


@pytest.mark.mpi(2)
def test_fields_do_not_depend_on_the_number_of_ranks(comm, flow, tmp_path, linked):
    keys = {"method": "memory", "every": 3, "fields": ("velocity",)}
    errors, _ = errors_of(comm, flow, tmp_path, linked, **keys)
    alone = comm.Split(comm.rank)
    if comm.rank == 0:
        scene, folder = flow
        (tmp_path / "one").mkdir()
        (tmp_path / "one/ground_truth.h5").symlink_to(folder / "ground_truth.h5")
        reconstruct.run(replace(scene, reconstruction=Reconstruction(**keys)), alone, tmp_path / "one")
        with h5py.File(tmp_path / "one/reconstruction.h5") as one, h5py.File(tmp_path / "reconstruction.h5") as many:
            first, second = (file["fields/reconstructed/velocity"][()] for file in (one, many))
        # Solves end at 2e-4 of the velocities, after as many iterations; sums have another order.
        np.testing.assert_allclose(first, second, atol=1e-4)
    comm.Barrier()
    assert errors["velocity_error"] < 0.1


@pytest.mark.mpi(2)
@pytest.mark.parametrize("method", ["least-squares", "memory"])
def test_a_stopped_reconstruction_is_the_one_never_stopped(comm, flow, tmp_path, linked, method):
    (scene, folder), found = flow, []
    scene = replace(scene, reconstruction=Reconstruction(method=method, every=3, fields=("velocity", "r"),
                                                         particles=True, samples=2))
    for steps in (10**9, 3):
        directory = tmp_path / str(steps)
        if comm.rank == 0:
            directory.mkdir()
            (directory / "ground_truth.h5").symlink_to(folder / "ground_truth.h5")
        comm.Barrier()
        if steps == 3:
            with pytest.raises(Stopped, match="from step 3 of the reconstruction"):
                reconstruct.run(scene, comm, directory, StopAtStep(comm, steps))
        reconstruct.run(scene, comm, directory)
        assert not (directory / "checkpoints-reconstruct").exists()
        with h5py.File(directory / "reconstruction.h5") as file:
            found.append({name: file[name][()] for name in (
                "fields/reconstructed/velocity", "fields/reconstructed/r", "particles/tracks/track/value",
                "fields/reconstructed/velocity_deviation", "particles/tracks/velocity_deviation/value",
                "particles/tracks/velocity/value", "errors_over_time/validation_error", "errors_of_fields/time")})
    for name, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][name], err_msg=name)


@pytest.mark.mpi(2)
def test_a_reconstruction_without_room_leaves_nothing_and_goes_on(comm, flow, tmp_path, linked, monkeypatch):
    """In place of a full disk the last rank may write so many bytes to a file."""
    monkeypatch.setattr(new_files, "MARGIN_BYTES", 2**12)
    scene, folder = flow
    linked(folder)
    scene = replace(scene, reconstruction=Reconstruction(fields=("velocity",), holdout=0.0))
    for kilobytes in (1, 100):
        with largest_file(comm, kilobytes * 1024, comm.size - 1), pytest.raises(WriteError, match="make room"):
            reconstruct.run(scene, comm, tmp_path)
        comm.Barrier()
        assert not list(tmp_path.rglob("*.partial")) and not (tmp_path / "reconstruction.h5").exists()
        comm.Barrier()
    reconstruct.run(scene, comm, tmp_path)
    assert (tmp_path / "reconstruction.h5").exists()
