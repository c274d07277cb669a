import pytest
import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reconstruction import reconstruct, reconstruct_with_gradient, volumes
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, WendlandC2
from tests.particles.configurations import LENGTH, positions

SUPPORT = 1.6
FAMILIES = {"spline": CubicSpline, "wendland": WendlandC2, "learned": lambda h: KernelNetwork(h).table()}
kernels = pytest.mark.parametrize("kernel", [make(SUPPORT) for make in FAMILIES.values()], ids=list(FAMILIES))


def pairs_of(points, senders, exclude_self=False, support=SUPPORT):
    neighbors = NeighborList(PeriodicBox(LENGTH), support, 0.0)
    neighbors.build(points, senders, exclude_self)
    return neighbors.pairs(points, senders)


def field(kernel, points, senders, values):
    volume = volumes(kernel, pairs_of(senders, senders, exclude_self=True, support=kernel.support))
    return kernel, pairs_of(points, senders, support=kernel.support), volume, values


def test_in_voids_values_lie_between_those_of_the_neighbours():
    """Some points have only distant neighbours with small weights. Weights of either sign would nearly cancel there."""
    network = KernelNetwork(SUPPORT, seed=2)
    with torch.no_grad():
        network.network.weights[-1].mul_(80)
    senders, points = positions(count=100), positions(count=2000, seed=9)
    values = torch.where(torch.arange(100) % 2 == 0, 1.0, -1.0).double()[:, None]
    with torch.no_grad():
        assert reconstruct(*field(network.table(), points, senders, values)).abs().max() <= 1 + 1e-12


@kernels
def test_the_gradient_is_the_derivative_of_the_average(kernel):
    senders, points = positions(count=300), positions(count=40, seed=9).requires_grad_()
    values, gradient = reconstruct_with_gradient(*field(kernel, points, senders, torch.sin(senders)))
    for component in range(3):
        (expected,) = torch.autograd.grad(values[:, component].sum(), points, retain_graph=True)
        assert torch.allclose(gradient[:, component], expected, atol=1e-11)
