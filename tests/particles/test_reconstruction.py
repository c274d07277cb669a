import pytest
import torch

from eddies.particles.neighbor_list import NeighborList
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reconstruction import reconstruct, reconstruct_with_gradient, volumes
from eddies.particles.smoothing_kernels import CubicSpline, KernelNetwork, WendlandC2
from tests.particles.configurations import LENGTH, positions

SUPPORT = 1.6
FAMILIES = {"spline": CubicSpline, "wendland": WendlandC2, "learned": lambda h: KernelNetwork(h).table()}
families = pytest.mark.parametrize("family", FAMILIES.values(), ids=list(FAMILIES))
kernels = pytest.mark.parametrize("kernel", [make(SUPPORT) for make in FAMILIES.values()], ids=list(FAMILIES))


def pairs_of(points, senders, exclude_self=False, support=SUPPORT):
    neighbors = NeighborList(PeriodicBox(LENGTH), support, 0.0)
    neighbors.build(points, senders, exclude_self)
    return neighbors.pairs(points, senders)


def field(kernel, points, senders, values):
    volume = volumes(kernel, pairs_of(senders, senders, exclude_self=True, support=kernel.support))
    return kernel, pairs_of(points, senders, support=kernel.support), volume, values


@kernels
def test_constants_are_reproduced_and_have_no_gradient(kernel):
    senders, points = positions("uneven", 400), positions(count=80)
    values = torch.tensor([[1.0, -30.0]], dtype=torch.float64).expand(400, 2)
    arguments = field(kernel, points, senders, values)
    near = arguments[1].sum(kernel.value(arguments[1].distance)) > 0
    assert torch.allclose(reconstruct(*arguments)[near], values[: int(near.sum())], rtol=1e-13)
    assert reconstruct_with_gradient(*arguments)[1].abs().max() < 1e-9
    assert 0 < near.sum() < 80


def test_nothing_is_reconstructed_where_no_particle_is():
    senders = torch.zeros(1, 3, dtype=torch.float64)
    points = torch.full((1, 3), 3.0, dtype=torch.float64, requires_grad=True)
    value = reconstruct(*field(CubicSpline(SUPPORT), points, senders, torch.ones(1, 2, dtype=torch.float64)))
    value.sum().backward()
    assert value.tolist() == [[0.0, 0.0]] and torch.isfinite(points.grad).all()


@kernels
def test_a_lone_particle_near_the_edge_gives_its_own_value(kernel):
    """Its weight is a small part of that at the centre, but there is no other."""
    senders = torch.tensor([[0.9 * SUPPORT, 0.0, 0.0], [3.0, 3.0, 3.0]], dtype=torch.float64)
    values = torch.tensor([[2.0, -5.0], [100.0, 100.0]], dtype=torch.float64)
    arguments = field(kernel, torch.zeros(1, 3, dtype=torch.float64), senders, values)
    assert torch.allclose(reconstruct(*arguments), values[:1], rtol=1e-14)
    # The field is constant there: what is left is rounding, over the distance in which the weight vanishes.
    assert reconstruct_with_gradient(*arguments)[1].abs().max() < 1e-12


@pytest.mark.parametrize("seed", [0, 2, 3])
def test_in_voids_values_lie_between_those_of_the_neighbours(seed):
    """With seven neighbours on average some points have only distant ones, where weights are small, and where those of
    a network without a fixed sign would nearly cancel: with these seeds values then leave the range."""
    network = KernelNetwork(SUPPORT, seed=seed)
    with torch.no_grad():
        network.network.weights[-1].mul_(80)
    senders, points = positions(count=100), positions(count=2000, seed=9)
    values = torch.where(torch.arange(100) % 2 == 0, 1.0, -1.0).double()[:, None]
    with torch.no_grad():
        assert reconstruct(*field(network.table(), points, senders, values)).abs().max() <= 1 + 1e-12


@kernels
def test_gradient_is_the_derivative_of_the_reconstruction(kernel):
    senders, points = positions(count=300), positions(count=40, seed=9).requires_grad_()
    arguments = field(kernel, points, senders, torch.sin(senders))
    values, gradient = reconstruct_with_gradient(*arguments)
    for component in range(3):
        (expected,) = torch.autograd.grad(values[:, component].sum(), points, retain_graph=True)
        assert torch.allclose(gradient[:, component], expected, atol=1e-11)


@kernels
def test_volumes_of_even_particles_fill_the_box(kernel):
    lattice = positions("lattice", 512)
    volume = volumes(kernel, pairs_of(lattice, lattice, exclude_self=True))
    assert torch.allclose(volume, volume[0].expand(512), rtol=1e-10)
    assert volume.sum().item() == pytest.approx(LENGTH**3, rel=0.05)


@families
def test_finer_particles_reconstruct_a_wave_better(family):
    points = positions(count=100, seed=5)
    errors = []
    for count in (500, 4000):
        senders = positions(count=count)
        kernel = family(LENGTH * (60 / count / (4 / 3 * torch.pi)) ** (1 / 3))
        value = reconstruct(*field(kernel, points, senders, torch.sin(senders)))
        errors.append((value - torch.sin(points)).norm().item())
    assert errors[1] < 0.6 * errors[0]


@kernels
def test_values_are_differentiable(kernel):
    senders, points = positions(count=60), positions(count=10, seed=9)
    pairs = pairs_of(points, senders)
    values = torch.rand(60, 2, dtype=torch.float64, requires_grad=True)
    volume = torch.rand(60, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(lambda v, a: reconstruct(kernel, pairs, v, a), (volume, values))
    assert torch.autograd.gradcheck(lambda v, a: reconstruct_with_gradient(kernel, pairs, v, a)[1], (volume, values))
