import pytest
import torch

from eddies.particles.neighborhood import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.particle_field import reconstruct_with_gradient, volumes
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, WendlandC2
from tests.particles.configurations import LENGTH, positions

SUPPORT = 1.6
KERNELS = {"spline": CubicSpline(SUPPORT), "wendland": WendlandC2(SUPPORT), "learned": KernelNetwork(SUPPORT).table()}


def pairs_of(points, senders, exclude_self):
    neighbors = NeighborList(PeriodicBox(LENGTH), SUPPORT, 0.0)
    neighbors.build(points, senders, exclude_self)
    return neighbors.pairs(points, senders)


@pytest.mark.parametrize("kernel", KERNELS.values(), ids=KERNELS)
def test_the_gradient_is_the_derivative_of_the_average(kernel):
    senders, points = positions(count=300), positions(count=40, seed=9).requires_grad_()
    volume = volumes(kernel, pairs_of(senders, senders, exclude_self=True))
    values, gradient = reconstruct_with_gradient(kernel, pairs_of(points, senders, False), volume, torch.sin(senders))
    for component in range(3):
        (expected,) = torch.autograd.grad(values[:, component].sum(), points, retain_graph=True)
        assert torch.allclose(gradient[:, component], expected, atol=1e-11)
