import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField, grid_points
from eddies.particles.smoothing_kernels import KernelNetwork

LENGTH = 2 * np.pi


def field_of(comm, per_side=16, cells=12):
    slab = SlabDecomposition(comm, LENGTH, cells)
    position = torch.from_numpy(release(slab, 3, per_side**3, "random")["position"])
    return ParticleField(slab, 2.5 * LENGTH / per_side, position, torch.cos(position), torch.float64)


def largest(comm, error):
    return float(global_max(comm, float(error.detach().abs().max()) if error.numel() else 0.0))


@pytest.mark.mpi(1, 2)
def test_volumes_by_table_and_their_gradient(comm):
    """Volumes for one table after the other, and their gradient by the weights against a difference."""
    field = field_of(comm)
    for seed in (1, 2):
        network = KernelNetwork(2.5 * LENGTH / 16, (5,), seed=seed).double()
        found = field.volumes_by_table(network.table())
        with torch.no_grad():
            expected = field.volumes(network.table())
        assert largest(comm, found / expected - 1) < 1e-12
        weight = network.network.weights[0]
        (gradient,) = torch.autograd.grad((found**2).sum(), weight)
        change, sums = torch.ones_like(weight), []
        for sign in (1, -1):
            with torch.no_grad():
                weight += sign * 1e-5 * change
                sums.append(float((field.volumes(network.table()) ** 2).sum()))
                weight -= sign * 1e-5 * change
        # Ghosts count on several ranks, so only sums over ranks agree.
        both = global_sum(comm, np.array([float((gradient * change).sum()), (sums[0] - sums[1]) / 2e-5]))
        assert both[0] == pytest.approx(both[1], rel=1e-6)


@pytest.mark.mpi(1, 2, 3)
def test_the_slabs_share_the_points_of_a_grid(comm):
    """Each point is on one rank; for a grid with a cell for each plane, on the rank of that plane."""
    cells = 16
    for planes in (cells, 3 * cells // 2):
        slab = SlabDecomposition(comm, LENGTH, planes)
        points = grid_points(slab, cells)
        heights = torch.unique(points[:, 2])
        axis = torch.arange(cells, dtype=torch.float64) * (LENGTH / cells)
        assert len(points) == len(heights) * cells**2
        assert torch.equal(points[: cells**2, :2].flip(1), torch.cartesian_prod(axis, axis))
        assert torch.equal(torch.cat(comm.allgather(heights)), axis)
        if planes == cells:
            assert torch.equal(heights, axis[slab.start : slab.stop])
