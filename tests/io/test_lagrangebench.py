"""Data sets for learned simulators: by the rules of LagrangeBench's reader, they hold the paths of the particles."""

import json
from contextlib import ExitStack

import h5py
import numpy as np
import pytest

from eddies.io.errors import WriteError
from eddies.io.hdf5 import create_product, open_product
from eddies.io.lagrangebench import shortcoming, write_dataset
from eddies.io.trajectories import Trajectory, TrajectoryWriter
from tests.full_disk import largest_file

PARTICLES, FRAMES, INTERVAL, LENGTH = 40, 18, 0.1, 2 * np.pi
PARTS = {"train": range(0, 8), "valid": range(8, 13), "test": range(13, 18)}
ACCELERATION = np.array([0.5, -1.0, 2.0])
FLOAT32 = 2e-6  # what rounding of positions leaves in second differences


def paths(times):
    """Unwrapped positions (frames, N, 3) of particles with velocities of their own and one acceleration; they cross the
    edges."""
    rng = np.random.default_rng(1)
    start, velocity = rng.uniform(0, LENGTH, (PARTICLES, 3)), 2 + rng.normal(size=(PARTICLES, 3))
    t = np.asarray(times)[:, None, None]
    return start + velocity * t + ACCELERATION * t**2 / 2


@pytest.fixture
def trajectory(comm, tmp_path):
    """A function that gives a stored trajectory: at equal intervals, unless other times are given."""
    files = ExitStack()

    def make(times=INTERVAL * np.arange(FRAMES), positions=None):
        path, where = tmp_path / f"{len([*tmp_path.iterdir()])}.h5", paths(times) if positions is None else positions
        with create_product(comm, path, "rollout", {}) as file:
            writer = TrajectoryWriter(file, "model", PARTICLES, LENGTH, {"position": (3,)}, np.float64)
            for step, (time, position) in enumerate(zip(times, where)):
                writer.append(step, time, 0, {"position": position % LENGTH})
        return Trajectory(files.enter_context(open_product(comm, path, "rollout")), "model")

    with files:
        yield make


def windows(path, length, stride):
    """(N, length, 3) of all runs of `length` frames, each `stride` after the last, of the trajectories in order."""
    with h5py.File(path) as file:
        for key in file:
            position, kind = file[key]["position"], file[key]["particle_type"]
            assert kind.shape == position.shape[1:2] and (kind[:] == 0).all()
            for first in range(0, len(position) - length + 1, stride):
                yield position[first:first + length].transpose(1, 0, 2)


def between(later, earlier, bounds):
    """Displacement in the periodic box, as the simulator takes it for a velocity."""
    edges = np.diff(bounds, axis=1).ravel()
    return (later - earlier + edges / 2) % edges - edges / 2


@pytest.mark.mpi(1)
def test_windows_and_statistics_are_those_of_the_paths(trajectory, tmp_path):
    write_dataset(tmp_path / "set", trajectory(), "flow", {"scene": "made up"})
    assert {path.name for path in (tmp_path / "set").iterdir()} == {"train.h5", "valid.h5", "test.h5", "metadata.json"}
    about = json.loads((tmp_path / "set" / "metadata.json").read_text())
    truth, first, second = paths(INTERVAL * np.arange(FRAMES)), [], []
    for part, frames in PARTS.items():
        # Training slides along a trajectory; validation cuts it into pieces that do not overlap.
        length, stride = (4, 1) if part == "train" else (5, 5)
        found = list(windows(tmp_path / "set" / f"{part}.h5", length, stride))
        assert len(found) == (len(frames) - length) // stride + 1
        assert about[f"sequence_length_{part}"] == len(frames) - 1 and about[f"num_trajs_{part}"] == 1
        for number, window in enumerate(found):
            expected = truth[frames.start + stride * number:][:length].transpose(1, 0, 2) % LENGTH
            assert window.dtype == np.float32 and window.shape == (PARTICLES, length, 3)
            assert np.abs(between(window, expected, about["bounds"])).max() < 1e-6
        first.append(np.diff(truth[frames], axis=0))
        second.append(np.diff(first[-1], axis=0))
    # All parts have the same weight. All particles have one acceleration.
    mean = np.mean([steps.mean(axis=(0, 1)) for steps in first], axis=0)
    deviation = np.sqrt(np.mean([((steps - mean)**2).mean(axis=(0, 1)) for steps in first], axis=0))
    assert np.allclose(about["vel_mean"], mean, atol=FLOAT32) and np.allclose(about["vel_std"], deviation, atol=FLOAT32)
    assert np.allclose(about["acc_mean"], ACCELERATION * INTERVAL**2, atol=FLOAT32)
    assert np.allclose(second[0], ACCELERATION * INTERVAL**2)
    assert about["dt"] * about["write_every"] == pytest.approx(INTERVAL)
    assert about["num_particles_max"] == PARTICLES and about["dim"] == 3
    assert about["periodic_boundary_conditions"] == [True] * 3 and np.allclose(about["bounds"], [[0, LENGTH]] * 3)
    assert about["dx"] ** 3 * PARTICLES == pytest.approx(LENGTH**3)
    assert about["dx"] < about["default_connectivity_radius"] < 1.5 * about["dx"]


@pytest.mark.mpi(1)
def test_what_does_not_vary_is_divided_by_one(trajectory, tmp_path):
    at_rest = np.broadcast_to(np.nextafter(LENGTH, 0), (FRAMES, PARTICLES, 3))
    write_dataset(tmp_path / "set", trajectory(positions=at_rest), "flow", {})
    about = json.loads((tmp_path / "set" / "metadata.json").read_text())
    assert about["vel_mean"] == about["acc_mean"] == [0.0] * 3 and about["vel_std"] == about["acc_std"] == [1.0] * 3
    with h5py.File(tmp_path / "set" / "test.h5") as file:
        # In single precision the place below the edge is the edge.
        assert (file["00000/position"][:] < LENGTH).all()


@pytest.mark.mpi(1)
def test_trajectories_that_make_no_data_set(trajectory):
    assert "has 8 frames" in shortcoming(trajectory(INTERVAL * np.arange(8)))
    assert shortcoming(trajectory(INTERVAL * np.arange(9))) is None
    assert "equal intervals" in shortcoming(trajectory([*INTERVAL * np.arange(9), 0.85]))
    broken = paths(INTERVAL * np.arange(FRAMES))
    broken[-1, 7] = np.nan
    assert "not finite" in shortcoming(trajectory(positions=broken))


@pytest.mark.mpi(1)
def test_a_part_that_cannot_be_written_leaves_the_whole_set_as_it_was(comm, trajectory, tmp_path):
    write_dataset(tmp_path / "set", trajectory(), "older", {})
    before = {path: path.read_bytes() for path in (tmp_path / "set").iterdir()}
    other = trajectory()
    with largest_file(comm, 100_000), pytest.raises(WriteError, match="train.h5.partial: .* bytes wanted"):
        write_dataset(tmp_path / "set", other, "newer", {})
    (tmp_path / "set/test.h5.partial").mkdir()
    with pytest.raises(WriteError, match="test.h5.partial: Is a directory"):
        write_dataset(tmp_path / "set", other, "newer", {})
    (tmp_path / "set/test.h5.partial").rmdir()
    assert {path: path.read_bytes() for path in (tmp_path / "set").iterdir()} == before
