"""VTK's own reader finds in VTKHDF files what the products hold."""

from contextlib import contextmanager

import h5py
import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy

from eddies.io import vtkhdf
from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import create_product, open_product
from eddies.io.provenance import read_provenance
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from tests.vtk_reader import VtkFile

CELLS, PARTICLES, LENGTH = 5, 7, 2 * np.pi
TIMES = (0.1, 0.25, 0.7)
COLUMNS = {"position": (3,), "velocity": (3,), "density": (), "velocity_gradient": (3, 3)}


def field(frame, components):
    return np.random.default_rng([frame, components]).random((components, *[CELLS] * 3), np.float32)


def column(frame, name):
    return np.random.default_rng([frame, *name.encode()]).random((PARTICLES, *COLUMNS[name]))


@contextmanager
def product(comm, folder, times=TIMES):
    """An open product with fields and particles at some times."""
    with create_product(comm, folder / "p.h5", "ground_truth", {"scene": "made up"}) as file:
        fields = FieldWriter(file, "filtered", CELLS, {"velocity": 3, "density": 1})
        particles = TrajectoryWriter(file, "tracers", PARTICLES, LENGTH, COLUMNS, np.float64, images=True)
        for frame, time in enumerate(times):
            fields.append(time, 0, {"velocity": field(frame, 3), "density": field(frame, 1)})
            particles.append(frame, time, 0, {name: column(frame, name) for name in COLUMNS})
    with open_product(comm, folder / "p.h5", "ground_truth") as file:
        yield file


@pytest.mark.mpi(1)
def test_fields_survive(comm, tmp_path, monkeypatch):
    """At any step, in any order; with the planes that close the periodic cube, copied in several parts."""
    monkeypatch.setattr(vtkhdf, "BLOCK_BYTES", 1000)
    with product(comm, tmp_path) as file:
        vtkhdf.write_images(tmp_path / "new" / "f.vtkhdf", FieldSeries(file, "filtered"), LENGTH,
                            np.array([0.5, 0, -1]), {})
    read = VtkFile(tmp_path / "new" / "f.vtkhdf")
    assert read.times == TIMES
    for frame in (2, 0, 1):
        data, arrays = read.step(frame)
        assert data.GetClassName() == "vtkImageData" and data.GetDimensions() == (CELLS + 1,) * 3
        assert data.GetOrigin() == (0.5, 0, -1) and data.GetSpacing() == (LENGTH / CELLS,) * 3
        assert arrays.keys() == {"velocity", "density"} and arrays["density"].ndim == 1
        for name, components in (("velocity", 3), ("density", 1)):
            values = np.moveaxis(arrays[name].reshape(*[CELLS + 1] * 3, components), -1, 0)
            closed = [np.arange(CELLS + 1) % CELLS] * 3
            assert np.array_equal(values, field(frame, components)[:, *np.ix_(*closed)])


@pytest.mark.mpi(1)
def test_components_and_axes_are_not_swapped(comm, tmp_path):
    """u = x, v = 2 y, w = 3 z, in the coordinates that VTK gives the points."""
    z, y, x = np.meshgrid(*[LENGTH * np.arange(CELLS) / CELLS] * 3, indexing="ij")
    with create_product(comm, tmp_path / "p.h5", "ground_truth", {}) as file:
        FieldWriter(file, "final", CELLS, {"velocity": 3}).append(0.0, 0, {"velocity": np.stack([x, 2 * y, 3 * z])})
    with open_product(comm, tmp_path / "p.h5", "ground_truth") as file:
        vtkhdf.write_images(tmp_path / "f.vtkhdf", FieldSeries(file, "final"), LENGTH, np.zeros(3), {})
    data, arrays = VtkFile(tmp_path / "f.vtkhdf").step(0)
    for point in range(data.GetNumberOfPoints()):
        position = np.array(data.GetPoint(point))
        if position.max() < LENGTH - 1e-6:  # the planes at L hold the values of those at 0
            assert np.allclose(arrays["velocity"][point], position * (1, 2, 3), atol=1e-5)  # float32


@pytest.mark.mpi(1)
def test_particles_and_their_origin_survive(comm, tmp_path):
    with product(comm, tmp_path) as file:
        origin, images = read_provenance(file), file["particles/tracers/image/value"][()]
        vtkhdf.write_points(tmp_path / "p.vtkhdf", Trajectory(file, "tracers"), origin)
    with h5py.File(tmp_path / "p.vtkhdf") as file:
        assert read_provenance(file) == origin and origin["scene"] == "made up"
    read = VtkFile(tmp_path / "p.vtkhdf")
    assert read.times == TIMES
    for frame in (2, 0, 1):
        data, arrays = read.step(frame)
        assert data.GetClassName() == "vtkPolyData"
        assert np.array_equal(vtk_to_numpy(data.GetPoints().GetData()), column(frame, "position"))
        assert data.GetNumberOfVerts() == data.GetNumberOfCells() == PARTICLES
        assert np.array_equal(vtk_to_numpy(data.GetVerts().GetConnectivityArray()), np.arange(PARTICLES))
        assert np.array_equal(arrays.pop("id"), np.arange(PARTICLES))
        assert np.array_equal(arrays.pop("image"), images[frame])
        assert arrays.keys() == COLUMNS.keys() - {"position"} and arrays["density"].ndim == 1
        for name, values in arrays.items():
            assert np.array_equal(values.reshape(PARTICLES, *COLUMNS[name]), column(frame, name))


@pytest.mark.mpi(1)
def test_a_single_frame_survives(comm, tmp_path):
    """The reader sees no time in such a file; it is kept as field data."""
    with product(comm, tmp_path, times=[0.4]) as file:
        vtkhdf.write_images(tmp_path / "f.vtkhdf", FieldSeries(file, "filtered"), LENGTH, np.zeros(3), {})
        vtkhdf.write_points(tmp_path / "p.vtkhdf", Trajectory(file, "tracers"), {})
    images, points = VtkFile(tmp_path / "f.vtkhdf"), VtkFile(tmp_path / "p.vtkhdf")
    for read in (images, points):
        assert read.times is None
        assert read.step(0)[0].GetFieldData().GetArray("time").GetValue(0) == 0.4
    values = images.step(0)[1]["velocity"].reshape(*[CELLS + 1] * 3, 3)
    assert np.array_equal(np.moveaxis(values, -1, 0)[:, :-1, :-1, :-1], field(0, 3))
    data, arrays = points.step(0)
    assert np.array_equal(vtk_to_numpy(data.GetPoints().GetData()), column(0, "position"))
    assert np.array_equal(arrays["velocity"], column(0, "velocity"))
