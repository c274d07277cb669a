"""A rollout and its truth, and the series that are computed from both."""

import numpy as np
import pytest

from eddies.io.hdf5 import open_product
from eddies.io.trajectories import Trajectory
from eddies.workflows.rollout.measured import TrueParticles, open_rollout
from tests.workflows.synthetic_run import START, write_run


@pytest.fixture
def directory(comm, tmp_path):
    """A synthetic run, forced and with a stationary state."""
    if comm.rank == 0:
        write_run(comm.Create_group(comm.group.Incl([0])), tmp_path, {"stationary": True}, injection_rate=0.5)
    comm.Barrier()
    return tmp_path


@pytest.mark.mpi(1)
def test_the_true_particles_are_those_of_the_ground_truth_at_the_times_of_the_rollout(comm, directory):
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        tracers = Trajectory(file, "tracers")
        truth = TrueParticles(tracers, START, np.array([0.0, 0.05, 0.1, 0.5, 0.6, 0.7]))
        # There is no frame at t = 0.05, and the last frame has no centred difference.
        assert truth.times.tolist() == [0.0, 0.1, 0.5] and truth.frames.tolist() == [6, 7, 11]
        assert set(truth.columns) == {"position", "velocity", "density", "image", "acceleration"}
        for column in ("position", "velocity", "density"):
            assert truth.read(1, column).dtype == np.float32
            assert np.array_equal(truth.read(1, column, 3, 9), tracers.read(7, column)[3:9].astype(np.float32))
        change = (tracers.read(8, "velocity") - tracers.read(6, "velocity")) / (tracers.times[8] - tracers.times[6])
        assert np.array_equal(truth.read(1, "acceleration"), change.astype(np.float32))
        # Paths begin within the box, at the start of the rollout.
        assert not truth.read(0, "image").any()
        assert np.array_equal(truth.read(2, "image"), tracers.read(11, "image") - tracers.read(6, "image"))


@pytest.mark.mpi(1)
def test_without_ground_truth_or_kernel_there_are_fewer_series(comm, directory):
    with open_rollout(directory, comm) as stored:
        groups = stored.groups()
        assert set(groups) == {"particles/truth", *(f"{what}{of}" for of in ("model", "truth") for what in (
            "spectra_of_", "fields/", "gradients/"))}
        assert stored.particles["model"].read(0, "velocity_gradient").shape == (600, 3, 3)
        times, columns = groups["fields/truth"]
        assert columns["velocity"](0).shape[0] == 3 and len(times) == 6
        assert "velocity_gradient" not in groups["particles/truth"][1]
    (directory / "kernel.h5").unlink()
    with open_rollout(directory, comm) as stored:
        assert stored.rollout.invariants is stored.rollout.planes is None and not stored.fields
        assert set(stored.groups()) == {"particles/truth", "spectra_of_model", "spectra_of_truth"}
    (directory / "ground_truth.h5").unlink()
    with open_rollout(directory, comm) as stored:
        assert stored.groups() == {} and list(stored.particles) == ["model"]
        with pytest.raises(ValueError, match="ground_truth.h5 is not here"):
            stored.rollout.common
