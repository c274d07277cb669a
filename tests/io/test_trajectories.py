"""Trajectories: what is read is what was written, on any number of ranks, in the H5MD layout."""

import numpy as np
import pytest

from eddies.io.hdf5 import ProductError, create_product, open_product
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from tests.changed_product import changed

COLUMNS = {"position": (3,), "density": (), "velocity_gradient": (3, 3)}
TOTAL, FRAMES = 11, 3
BLOCKS = {"even": lambda comm: np.linspace(0, TOTAL, comm.size + 1).astype(int),
          "all on the first rank": lambda comm: np.array([0] + [TOTAL] * comm.size),
          "all on the last rank": lambda comm: np.array([0] * comm.size + [TOTAL])}


def values(frame, column):
    return np.random.default_rng([frame, len(column)]).random((TOTAL, *COLUMNS[column]))


def write(comm, path, dtype, starts):
    start, stop = starts[comm.rank], starts[comm.rank + 1]
    with create_product(comm, path, "ground_truth", {}) as file:
        for name in ("model", "truth"):
            writer = TrajectoryWriter(file, name, TOTAL, 2 * np.pi, COLUMNS, dtype)
            for frame in range(FRAMES):
                writer.append(10 * frame, 0.5 * frame, start,
                              {column: values(frame, column)[start:stop] for column in COLUMNS})


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("blocks", BLOCKS)
@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_frames_survive(comm, tmp_path, blocks, dtype):
    write(comm, tmp_path / "t.h5", dtype, BLOCKS[blocks](comm))
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


@pytest.mark.mpi(1, 2)
def test_layout_is_h5md(comm, tmp_path):
    write(comm, tmp_path / "t.h5", np.float32, BLOCKS["even"](comm))
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        assert list(file["h5md"].attrs["version"]) == [1, 1]
        assert {"name", "version"} <= file["h5md/creator"].attrs.keys()
        assert "name" in file["h5md/author"].attrs
        group = file["particles/model"]
        assert group["box"].attrs["dimension"] == 3
        assert list(group["box"].attrs["boundary"]) == [b"periodic"] * 3
        assert np.allclose(group["box/edges"], 2 * np.pi)
        assert np.array_equal(group["id"], np.arange(TOTAL))
        for column, shape in COLUMNS.items():
            element = group[column]
            assert element["value"].shape == (FRAMES, TOTAL, *shape)
            assert element["time"] == group["time"] and element["step"] == group["step"]


@pytest.mark.mpi(1)
def test_unknown_names_list_the_others(comm, tmp_path):
    write(comm, tmp_path / "t.h5", np.float32, BLOCKS["even"](comm))
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file:
        with pytest.raises(ProductError, match="holds no particles/tracers"):
            Trajectory(file, "tracers")
        with pytest.raises(ProductError, match="holds no velocity; .*position"):
            Trajectory(file, "model").read(0, "velocity")


@pytest.mark.mpi(1)
@pytest.mark.parametrize("place, index, value, told", [
    ("time", 1, 1.0, "time, holds times that do not increase"),
    ("time", 2, np.nan, "time, holds times that do not increase"),
    ("id", 3, 4, "id, holds ids that are not in order"),
    ("position/value", (1, 5, 0), -0.1, "position/value, frame 1: holds values that are outside of 0 to 6.28319"),
    ("position/value", (1, 5, 0), 6.3, "position/value, frame 1: holds values that are outside of 0 to 6.28319"),
    ("density/value", (1, 5), np.inf, "density/value, frame 1: holds values that are not finite")])
def test_values_that_no_stage_writes_are_told(comm, tmp_path, place, index, value, told):
    write(comm, tmp_path / "t.h5", np.float32, BLOCKS["even"](comm))
    with changed(tmp_path / "t.h5") as file:
        file[f"particles/model/{place}"][index] = value
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file, pytest.raises(ProductError) as error:
        trajectory = Trajectory(file, "model")
        assert len(trajectory.times) == FRAMES
        for column in COLUMNS:
            trajectory.read(1, column, 2, 8)
    assert str(error.value) == (f"{tmp_path / 't.h5'}: /particles/model/{told}; remove it and run `eddies dns` again")


@pytest.mark.mpi(1)
def test_fewer_times_than_frames_are_told(comm, tmp_path):
    write(comm, tmp_path / "t.h5", np.float32, BLOCKS["even"](comm))
    with changed(tmp_path / "t.h5") as file:
        file["particles/model/time"].resize(FRAMES - 1, 0)
    told = r"value, holds \(3, 11\) frames and particles where there are \(2, 11\) times and ids"
    with open_product(comm, tmp_path / "t.h5", "ground_truth") as file, pytest.raises(ProductError, match=told):
        Trajectory(file, "model").times
