"""Trajectories: what is read is what was written, on any number of ranks, in the H5MD layout."""

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError, create_product, open_product
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from tests.changed_product import changed

COLUMNS = {"position": (3,), "density": (), "velocity_gradient": (3, 3)}
TOTAL, FRAMES = 11, 3


def values(frame, column):
    return np.random.default_rng([frame, len(column)]).random((TOTAL, *COLUMNS[column]))


def write(comm, path, dtype=np.float32, starts=None):
    """Write a trajectory; the blocks of ranks begin at `starts`, by default they are about equal."""
    starts = np.linspace(0, TOTAL, comm.size + 1).astype(int) if starts is None else starts
    start, stop = starts[comm.rank], starts[comm.rank + 1]
    with create_product(comm, path, "ground_truth", {}) as file:
        for name in ("model", "truth"):
            writer = TrajectoryWriter(file, name, TOTAL, 2 * np.pi, COLUMNS, dtype)
            for frame in range(FRAMES):
                writer.append(10 * frame, 0.5 * frame, start,
                              {column: values(frame, column)[start:stop] for column in COLUMNS})


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("dtype, owner", [(np.float64, None), (np.float32, "last")])
def test_frames_survive(comm, tmp_path, dtype, owner):
    """Equal blocks, or all rows on the last rank."""
    write(comm, tmp_path / "t.h5", dtype, [0] * comm.size + [TOTAL] if owner else None)
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        trajectory = Trajectory(file, "model")
        assert np.array_equal(trajectory.times, [0, 0.5, 1]) and np.array_equal(trajectory.steps, [0, 10, 20])
        assert (trajectory.total, trajectory.length) == (TOTAL, 2 * np.pi)
        assert set(trajectory.columns) == COLUMNS.keys()
        for frame in range(FRAMES):
            for column in COLUMNS:
                read = trajectory.read(frame, column)
                assert read.dtype == dtype
                assert np.array_equal(read, values(frame, column).astype(dtype))
        assert np.array_equal(trajectory.read(1, "position", 4, 7), values(1, "position")[4:7].astype(dtype))
        assert trajectory.read(-1, "density", 5, 5).shape == (0,)


@pytest.mark.mpi(1)
def test_layout_is_h5md(comm, tmp_path):
    write(comm, tmp_path / "t.h5")
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        assert list(file["h5md"].attrs["version"]) == [1, 1]
        assert {"name", "version"} <= file["h5md/creator"].attrs.keys()
        assert "name" in file["h5md/author"].attrs
        group = file["particles/model"]
        assert group["box"].attrs["dimension"] == 3
        assert list(group["box"].attrs["boundary"]) == [b"periodic"] * 3
        assert np.array_equal(group["box/edges/value"], [np.diag([2 * np.pi] * 3)] * FRAMES)
        assert np.array_equal(group["id"], np.arange(TOTAL))
        for column, shape in COLUMNS.items():
            element = group[column]
            assert element["value"].shape == (FRAMES, TOTAL, *shape)
            assert element["time"] == group["time"] and element["step"] == group["step"]


@pytest.mark.mpi(1)
def test_mdanalysis_reads_the_frames(comm, tmp_path):
    from MDAnalysis import Universe
    write(comm, tmp_path / "t.h5")
    universe = Universe.empty(TOTAL)
    universe.load_new(str(tmp_path / "t.h5"), format="H5MD")
    assert len(universe.trajectory) == FRAMES
    for frame, step in enumerate(universe.trajectory):
        assert step.data["time"] == 0.5 * frame
        assert np.allclose(step.positions, values(frame, "position"), rtol=1e-6)
        assert np.allclose(step.dimensions, [*[2 * np.pi] * 3, 90, 90, 90])


@pytest.mark.mpi(1)
def test_unknown_names_list_the_others(comm, tmp_path):
    write(comm, tmp_path / "t.h5")
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        with pytest.raises(ProductError, match="holds no particles/tracers"):
            Trajectory(file, "tracers")
        with pytest.raises(ProductError, match="holds no velocity; .*position"):
            Trajectory(file, "model").read(0, "velocity")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("place, index, value, message", [
    ("time", 1, 1.0, "do not increase"), ("time", 2, np.nan, "do not increase"), ("id", 3, 4, "not in order"),
    ("position/value", (1, 5, 0), -0.1, "frame 1: .*outside the range 0 to 6.28319"),
    ("position/value", (1, 5, 0), 6.3, "frame 1: .*outside the range 0 to 6.28319"),
    ("density/value", (1, 5), np.inf, "frame 1: .*not finite"), ("time", None, 2, r"holds \(3, 11\) frames")])
def test_malformed_trajectories_are_refused(comm, tmp_path, place, index, value, message):
    """Also one with less times (value) than frames."""
    write(comm, tmp_path / "t.h5")
    with changed(tmp_path / "t.h5") as file:
        dataset = file[f"particles/model/{place}"]
        if index is None:
            dataset.resize(value, 0)
        else:
            dataset[index] = value
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        with pytest.raises(ProductError, match=f"t.h5: /particles/model/.*{message}.* run `eddies dns` again"):
            trajectory = Trajectory(file, "model")
            assert len(trajectory.times) == FRAMES
            for column in COLUMNS:
                trajectory.read(1, column, 2, 8)
