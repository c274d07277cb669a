import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.cloud import ParticleCloud, grid_points
from eddies.particles.smoothing_kernels import WendlandC2

LENGTH = 2 * np.pi


def cloud_of(comm, field, per_side=16, cells=12):
    slab = SlabDecomposition(comm, LENGTH, cells)
    position = torch.from_numpy(release(slab, 3, per_side, "lattice")["position"])
    return ParticleCloud(slab, 2.5 * LENGTH / per_side, position, field(position), torch.float64)


def largest(comm, error):
    return float(global_max(comm, float(error.abs().max()) if error.numel() else 0.0))


@pytest.mark.mpi(1, 2, 3)
def test_constants_are_exact_and_have_no_gradient(comm):
    cloud = cloud_of(comm, lambda x: torch.full_like(x, 2.0))
    kernel = WendlandC2(2.5 * LENGTH / 16)
    for velocity, gradient in (cloud.on_whole_grid(kernel), cloud.at_particles(kernel)):
        assert largest(comm, velocity - 2) < 1e-12 and largest(comm, gradient) < 1e-11


@pytest.mark.mpi(1, 2, 3)
def test_a_smooth_field_and_its_gradient_on_any_number_of_ranks(comm):
    cloud = cloud_of(comm, lambda x: torch.stack([torch.sin(x[:, 1]), torch.sin(x[:, 2]), torch.sin(x[:, 0])], dim=1))
    velocity, gradient = cloud.on_whole_grid(WendlandC2(2.5 * LENGTH / 16))
    points = grid_points(cloud.decomposition)
    # The kernel attenuates k = 1 by a few percent, and the jittered lattice adds noise of that order.
    assert largest(comm, velocity[:, 0] - torch.sin(points[:, 1])) < 0.12
    assert largest(comm, gradient[:, 1, 2] - torch.cos(points[:, 2])) < 0.4
    assert largest(comm, gradient[:, 1, 0]) < 0.4
