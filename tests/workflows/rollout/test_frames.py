"""What a rollout stores: the density of model and truth alike, or of neither."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.io.hdf5 import create_product, open_product
from eddies.io.trajectories import Trajectory
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.frames import RolloutFrames
from tests.workflows.synthetic_run import LENGTH, write_ground_truth

START = 1


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("of_truth", [True, False])
@pytest.mark.parametrize("of_model", [True, False])
def test_density_is_stored_where_both_have_one(comm, tmp_path, of_truth, of_model):
    if comm.rank == 0:
        write_ground_truth(comm.Create_group(comm.group.Incl([0])), tmp_path, frames=4, density=of_truth)
    comm.Barrier()
    with open_product(comm, tmp_path / "ground_truth.h5", "ground_truth") as truth_file:
        truth = GroundTruth(truth_file, SlabDecomposition(comm, LENGTH, 16))
        own = truth.particles(START)
        own["density"] = np.full(len(own["id"]), 3.0)
        particles = SimpleNamespace(to_numpy=lambda: {name: column for name, column in own.items()
                                                      if of_model or name != "density"})
        frames = RolloutFrames(tmp_path / "checkpoints", truth, CubicSpline(0.9), truth.times[START], of_model)
        with frames.segments as segments, create_product(comm, tmp_path / "rollout.h5", "rollout", {}) as file:
            frames.store(0, 0.0, particles, torch.full((len(own["id"]), 3), 2.0))
            segments.assemble(file)
        names = [name for name in truth.trajectory.columns if name != "image"]  # which counts from the first frame
        true = [truth.trajectory.read(START, name) for name in names]
    with open_product(comm, tmp_path / "rollout.h5", "rollout") as file:
        model, stored = Trajectory(file, "model"), Trajectory(file, "truth")
        both = {"position", "image", "velocity", "acceleration", "velocity_gradient"}
        both |= {"density"} if of_truth and of_model else set()
        assert set(model.columns) == set(stored.columns) == both
        for name, values in zip(names, true):
            if name in both:
                assert np.array_equal(stored.read(0, name), values.astype(np.float32))
        assert np.array_equal(model.read(0, "position"), stored.read(0, "position"))
        assert np.all(model.read(0, "acceleration") == 2)
        assert "density" not in both or np.all(model.read(0, "density") == 3)
