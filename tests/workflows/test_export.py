"""The export of a run: a file for each series of its products, with the same numbers."""

import logging

import h5py
import numpy as np
import pytest
from mpi4py import MPI
from vtkmodules.util.numpy_support import vtk_to_numpy

from eddies.io.fields import FieldSeries, FieldWriter
from eddies.io.hdf5 import ProductError, create_product, open_product
from eddies.io.trajectories import Trajectory
from eddies.workflows import export
from eddies.workflows.rollout.measured import open_rollout

from tests.commands import first_rank
from tests.changed_product import changed
from tests.vtk_reader import VtkFile
from tests.workflows.synthetic_run import write_run

SERIES = {"ground_truth": {"fields": ["filtered"], "particles": ["tracers"]},
          "rollout": {"fields": ["model", "truth"], "particles": ["model", "truth"]}}


def exported(directory):
    return {path.name for path in directory.iterdir()}


def compare(path, group, source):
    """Check the first and the last step of a file against a series."""
    read = VtkFile(path)
    assert read.times == (tuple(source.times) if len(source.times) > 1 else None)
    for frame in (len(source.times) - 1, 0):
        data, arrays = read.step(frame)
        if group == "particles":
            position = vtk_to_numpy(data.GetPoints().GetData())
            assert np.array_equal(position, source.read(frame, "position").astype(position.dtype))
            assert np.array_equal(arrays["id"], np.arange(source.total))
            assert set(arrays) == {"id", *source.columns} - {"position"}
            for column in set(source.columns) - {"position"}:
                values = source.read(frame, column)
                assert np.array_equal(arrays[column], values.reshape(len(values), -1).squeeze()), column
        else:
            assert np.allclose(data.GetBounds(), [0, 2 * np.pi] * 3)
            field = source.read(frame, "velocity")
            points = field.shape[1] + 1
            velocity = np.moveaxis(arrays["velocity"].reshape(points, points, points, 3), -1, 0)
            assert np.array_equal(velocity[:, :-1, :-1, :-1], field)


@pytest.mark.mpi(1, 2)
def test_every_series_of_a_run(comm, tmp_path):
    """Stored and computed ones, with density on one rank; a second export replaces the first."""
    density = comm.size == 1
    first_rank(comm, write_run, MPI.COMM_SELF, tmp_path, truth={"cells": 8}, total=100, frames=6, density=density)
    for _ in range(1 + (comm.size == 1)):
        export.run(tmp_path, tmp_path / "vtkhdf", comm)
    if comm.rank == 0:
        names = {(product, group, name) for product, groups in SERIES.items() for group in groups
                 for name in groups[group]}
        assert exported(tmp_path / "vtkhdf") == {f"{'-'.join(parts)}.vtkhdf" for parts in names}
        alone = MPI.COMM_SELF
        with open_product(alone, tmp_path / "ground_truth.h5", "ground_truth") as truth, open_rollout(
                tmp_path, alone) as measured:
            tracers, made = Trajectory(truth, "tracers"), {"fields": measured.fields, "particles": measured.particles}
            assert ("density" in tracers.columns) == ("density" in measured.rollout.model.columns) == density
            stored = {"fields": {"filtered": FieldSeries(truth, "filtered")}, "particles": {"tracers": tracers}}
            for product, group, name in names:
                compare(tmp_path / "vtkhdf" / f"{product}-{group}-{name}.vtkhdf", group, (
                    stored if product == "ground_truth" else made)[group][name])
    comm.Barrier()


@pytest.mark.mpi(1)
def test_all_series_of_a_run_from_tracks_have_the_units_of_the_file(comm, tmp_path):
    """So they lie on each other, and on the fields of a reconstruction, which are stored in these units."""
    unit, corner = 3.0, np.array([1.0, -2.0, 0.5])
    write_run(comm, tmp_path, truth={"cells": 8}, total=100, frames=6)
    with changed(tmp_path / "ground_truth.h5") as file:
        file.create_group("tracks").attrs.update(length_unit=unit, corner=corner)
        stored = {name: file[f"particles/tracers/{name}/value"][0] for name in ("position", "velocity", "density")}
    with create_product(comm, tmp_path / "reconstruction.h5", "reconstruction", {}) as file:
        FieldWriter(file, "reconstructed", 8, {"velocity": 3}).append(0.0, 0, {"velocity": np.ones((3, 8, 8, 8))})
        file.create_group("about").attrs.update(length_unit=unit, corner=corner)
    export.run(tmp_path, tmp_path / "vtkhdf", comm)
    for name in ("ground_truth-fields-filtered", "rollout-fields-model", "reconstruction-fields-reconstructed"):
        with h5py.File(tmp_path / f"vtkhdf/{name}.vtkhdf") as file:
            root = file["VTKHDF"]
            assert root.attrs["Spacing"] * root.attrs["WholeExtent"][1] == pytest.approx(2 * np.pi * unit)
            assert np.array_equal(root.attrs["Origin"], -corner)
            assert name[:3] != "rec" or (root["PointData/velocity"][()] == 1).all()
    with h5py.File(tmp_path / "vtkhdf/ground_truth-particles-tracers.vtkhdf") as file:
        root, rows = file["VTKHDF"], slice(100)
        assert np.allclose(root["Points"][rows], unit * stored["position"] - corner)
        assert np.allclose(root["PointData/velocity"][rows], unit * stored["velocity"])
        assert np.array_equal(root["PointData/density"][rows], stored["density"])


@pytest.mark.mpi(2)
def test_particles_as_data_sets(comm, tmp_path, caplog):
    """The truth has too few frames."""
    first_rank(comm, write_run, MPI.COMM_SELF, tmp_path, total=100, frames=11)
    with caplog.at_level(logging.INFO, logger="eddies"):
        export.run(tmp_path, tmp_path / "sets", comm, "lagrangebench")
    if comm.rank == 0:
        assert exported(tmp_path / "sets") == {"ground_truth-particles-tracers", "rollout-particles-model"}
        assert "rollout-fields-model is left out: a data set holds particles only" in caplog.text
        assert "rollout-particles-truth is left out: it has 6 frames" in caplog.text
        with h5py.File(tmp_path / "sets/rollout-particles-model/valid.h5") as copy, h5py.File(
                tmp_path / "rollout.h5") as file:
            stored = file["particles/model/position/value"][5:8]
            assert np.array_equal(copy["00000/position"], stored.astype(np.float32))
            assert copy.attrs["provenance"] == file.attrs["provenance"]


@pytest.mark.mpi(1)
def test_a_run_without_tracers_has_its_last_field(comm, tmp_path):
    """It has no data set. A series without frames is left out."""
    with create_product(comm, tmp_path / "ground_truth.h5", "ground_truth", {}) as file:
        FieldWriter(file, "filtered", 4, {"velocity": 3})
        FieldWriter(file, "final", 4, {"velocity": 3}).append(0.0, 0, {"velocity": np.ones((3, 4, 4, 4))})
    export.run(tmp_path, tmp_path / "vtkhdf", comm)
    assert exported(tmp_path / "vtkhdf") == {"ground_truth-fields-final.vtkhdf"}
    with pytest.raises(ProductError, match=r"\[tracers\]"):
        export.run(tmp_path, tmp_path / "sets", comm, "lagrangebench")
    assert not (tmp_path / "sets").exists()


@pytest.mark.mpi(2)
def test_a_run_with_nothing_to_export(comm, tmp_path):
    """All ranks raise, none waits, and no directory is made."""
    for content, message in (("nothing", "has no fields or particles"), ("no series", "has no fields or particles"),
                             ("unfinished", "ground_truth.h5: unfinished")):
        if comm.rank == 0 and content == "no series":
            with create_product(MPI.COMM_SELF, tmp_path / "ground_truth.h5", "ground_truth", {}):
                pass
        elif comm.rank == 0 and content == "unfinished":
            with h5py.File(tmp_path / "ground_truth.h5", "w") as file:
                file.attrs.update(kind="ground_truth", complete=False)
        comm.Barrier()
        with pytest.raises(ProductError, match=message):
            export.run(tmp_path, tmp_path / "vtkhdf", comm)
        assert not (tmp_path / "vtkhdf").exists()
        comm.Barrier()
