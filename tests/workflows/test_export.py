"""The export of a run: a file for each series of its products, equal to what they hold."""

import h5py
import numpy as np
import pytest
from vtkmodules.util.numpy_support import vtk_to_numpy

from eddies.io.fields import FieldWriter
from eddies.io.hdf5 import ProductError, create_product, write_table
from eddies.workflows import export

from tests.vtk_reader import VtkFile
from tests.workflows.synthetic_run import write_ground_truth, write_kernel, write_rollout

SERIES = {"ground_truth-fields-filtered", "rollout-fields-model", "rollout-fields-truth", "rollout-fields-filtered",
          "rollout-particles-model", "rollout-particles-truth"}


def exported(directory):
    return {path.name for path in directory.iterdir()}


def compare(path, product):
    """Check the first and the last step of a file against the product."""
    group, name = path.stem.split("-")[1:]
    read = VtkFile(path)
    with h5py.File(product) as file:
        source = file[group][name]
        assert read.times == (tuple(source["time"]) if len(source["time"]) > 1 else None)
        for frame in (len(source["time"]) - 1, 0):
            data, arrays = read.step(frame)
            if group == "particles":
                assert np.array_equal(vtk_to_numpy(data.GetPoints().GetData()), source["position/value"][frame])
                assert np.array_equal(arrays["id"], source["id"])
                assert ("density" in arrays) == ("density" in source)
                if "density" in source:
                    assert np.array_equal(arrays["density"], source["density/value"][frame])
                assert np.array_equal(arrays["velocity"], source["velocity/value"][frame])
            else:
                assert np.allclose(data.GetBounds(), [0, 2 * np.pi] * 3)
                points = source.attrs["cells"] + 1
                velocity = np.moveaxis(arrays["velocity"].reshape(points, points, points, 3), -1, 0)
                assert np.array_equal(velocity[:, :-1, :-1, :-1], source["velocity"][frame])


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("density", [True, False])
def test_every_series_of_a_run(comm, tmp_path, density):
    if comm.rank == 0:
        alone = comm.Create_group(comm.group.Incl([0]))
        write_ground_truth(alone, tmp_path, cells=8)
        write_rollout(alone, tmp_path, total=20, cells=6, frames=6, density=density)
    comm.Barrier()
    for _ in range(2):  # the second export replaces the first
        export.run(tmp_path, tmp_path / "vtkhdf", comm)
    if comm.rank == 0:
        assert exported(tmp_path / "vtkhdf") == {f"{name}.vtkhdf" for name in SERIES}
        for path in (tmp_path / "vtkhdf").iterdir():
            compare(path, tmp_path / f"{path.stem.split('-')[0]}.h5")


@pytest.mark.mpi(1)
def test_a_run_without_tracers_has_its_last_field(comm, tmp_path):
    write_ground_truth(comm, tmp_path, tracers=False, cells=8)
    export.run(tmp_path, tmp_path / "elsewhere", comm)
    assert exported(tmp_path / "elsewhere") == {"ground_truth-fields-final.vtkhdf"}


@pytest.mark.mpi(1, 2)
def test_particles_as_data_sets(comm, tmp_path, caplog):
    """Of a rollout; its truth, three frames shorter, is too short."""
    if comm.rank == 0:
        write_rollout(comm.Create_group(comm.group.Incl([0])), tmp_path, total=20, cells=6, frames=11)
    comm.Barrier()
    export.run(tmp_path, tmp_path / "sets", comm, "lagrangebench")
    if comm.rank == 0:
        assert exported(tmp_path / "sets") == {"rollout-particles-model"}
        assert "particles/truth of rollout.h5 is left out: has 8 frames" in caplog.text
        with h5py.File(tmp_path / "sets/rollout-particles-model/valid.h5") as copy, h5py.File(
                tmp_path / "rollout.h5") as file:
            stored = file["particles/model/position/value"][5:8]
            assert np.array_equal(copy["00000/position"], stored.astype(np.float32))
            assert copy.attrs["provenance"] == file.attrs["provenance"]


@pytest.mark.mpi(1)
def test_a_run_without_tracers_makes_no_data_set(comm, tmp_path):
    write_ground_truth(comm, tmp_path, tracers=False, cells=8)
    with pytest.raises(ProductError, match=r"holds no particles that make a data set.* a scene that has \[tracers\]"):
        export.run(tmp_path, tmp_path / "sets", comm, "lagrangebench")
    assert not (tmp_path / "sets").exists()


@pytest.mark.mpi(1)
def test_a_series_without_frames_is_left_out(comm, tmp_path):
    """As the filtered fields of a rollout whose times fall between those of the ground truth's fields."""
    with create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
        FieldWriter(file, "filtered", 4, {"velocity": 3})
        FieldWriter(file, "model", 4, {"velocity": 3}).append(0.0, 0, {"velocity": np.ones((3, 4, 4, 4))})
    export.run(tmp_path, tmp_path / "vtkhdf", comm)
    assert exported(tmp_path / "vtkhdf") == {"rollout-fields-model.vtkhdf"}


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("content", ["nothing", "no such directory", "only a kernel", "a product without series",
                                     "an unfinished product"])
def test_a_run_with_nothing_to_export(comm, tmp_path, content):
    """All ranks raise, none waits, and no directory is made."""
    run, message = tmp_path, "holds no fields or particles.*run `eddies dns SCENE` first"
    if comm.rank == 0:
        alone = comm.Create_group(comm.group.Incl([0]))
        if content == "only a kernel":
            write_kernel(alone, tmp_path)
        elif content == "a product without series":
            with create_product(alone, tmp_path / "ground_truth.h5", "ground_truth", {}) as file:
                write_table(file, "statistics", {"time": [0.0]})
        elif content == "an unfinished product":
            with h5py.File(tmp_path / "ground_truth.h5", "w") as file:
                file.attrs.update(kind="ground_truth", complete=False)
    if content == "no such directory":
        run = tmp_path / "absent"
    elif content == "an unfinished product":
        message = "ground_truth.h5: unfinished"
    comm.Barrier()
    with pytest.raises(ProductError, match=message):
        export.run(run, tmp_path / "vtkhdf", comm)
    assert not (tmp_path / "vtkhdf").exists()
