import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_field import ParticleField, grid_points
from eddies.particles.smoothing_kernels import KernelNetwork, WendlandC2

LENGTH = 2 * np.pi


def field_of(comm, velocity, per_side=16, cells=12, placement="lattice"):
    slab = SlabDecomposition(comm, LENGTH, cells)
    position = torch.from_numpy(release(slab, 3, per_side, placement)["position"])
    return ParticleField(slab, 2.5 * LENGTH / per_side, position, velocity(position), torch.float64)


def largest(comm, error):
    return float(global_max(comm, float(error.abs().max()) if error.numel() else 0.0))


@pytest.mark.mpi(1, 2, 3)
def test_constants_are_exact_and_have_no_gradient(comm):
    field = field_of(comm, lambda x: torch.full_like(x, 2.0))
    kernel = WendlandC2(2.5 * LENGTH / 16)
    volume = field.volumes(kernel)
    for velocity, gradient in (field.averaged(kernel, volume, field.points), field.at_particles(kernel, volume)):
        assert largest(comm, velocity - 2) < 1e-12 and largest(comm, gradient) < 1e-11


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("neighbors", [60, 2])
def test_velocities_spread_on_the_grid_are_those_of_the_neighbours_of_its_points(comm, neighbors):
    """Also with so few neighbours that some points have none, and a kernel of less support than the field's."""
    field = field_of(comm, torch.cos, per_side=12, cells=16, placement="random")
    kernel = WendlandC2(LENGTH / 12 * (neighbors / (4 / 3 * np.pi)) ** (1 / 3))
    volume = field.volumes(kernel)
    expected, spread = field.averaged(kernel, volume, field.points)[0], field.velocity_on_whole_grid(kernel, volume)
    assert spread.shape == expected.shape and largest(comm, expected) > 0.5
    # The order of summation differs, and where the sum of weights nearly vanishes, so do its last digits.
    assert largest(comm, spread - expected) < 1e-11
    empty = float(global_sum(comm, float((expected == 0).all(1).sum())))
    assert (empty > 100) == (neighbors == 2)


@pytest.mark.mpi(1, 2)
def test_volumes_and_their_gradient_by_entries_of_the_table(comm):
    field = field_of(comm, torch.cos, placement="random")
    for seed in (1, 2):
        network = KernelNetwork(2.5 * LENGTH / 16, (5,), seed=seed).double()
        found, expected = (volumes(network.table()) for volumes in (field.volumes_by_table, field.volumes))
        assert largest(comm, found / expected - 1) < 1e-12
        by = [torch.autograd.grad((volumes**2).sum(), list(network.parameters())) for volumes in (found, expected)]
        assert all(torch.allclose(a, b, rtol=1e-9, atol=1e-12) and bool(b.abs().max() > 0) for a, b in zip(*by))


@pytest.mark.mpi(1, 2, 3)
def test_a_smooth_field_and_its_gradient_on_any_number_of_ranks(comm):
    field = field_of(comm, lambda x: torch.stack([torch.sin(x[:, 1]), torch.sin(x[:, 2]), torch.sin(x[:, 0])], dim=1))
    kernel = WendlandC2(2.5 * LENGTH / 16)
    velocity, gradient = field.averaged(kernel, field.volumes(kernel), field.points)
    points = grid_points(field.decomposition, field.decomposition.planes)
    # The kernel attenuates k = 1 by a few percent, and the jittered lattice adds noise of that order.
    assert largest(comm, velocity[:, 0] - torch.sin(points[:, 1])) < 0.12
    assert largest(comm, gradient[:, 1, 2] - torch.cos(points[:, 2])) < 0.4
    assert largest(comm, gradient[:, 1, 0]) < 0.4


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells", [16, 36])
def test_the_slabs_share_the_points_of_a_grid(comm, cells):
    """Each stands on one rank; of a grid with a cell for each plane, on the rank of that plane."""
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
