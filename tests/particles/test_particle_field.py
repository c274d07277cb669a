"""Samples of a velocity field: volumes, averages and kriging, also by dense equations, on any number of ranks."""

import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.neighborhood import NeighborList
from eddies.particles.particle_field import Form, ParticleField, grid_points, reconstruct_with_gradient, volumes
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.smoothing_kernels import CubicSpline, HermiteKernel, KernelNetwork, WendlandC2
from tests.kernels.reference_kriging import solved
from tests.particles.configurations import LENGTH, positions

SIDE, CELLS = 12, 16
SPACING = LENGTH / SIDE
SUPPORT = SPACING * (60 / (4 / 3 * np.pi)) ** (1 / 3)
FORMS = "average", "kriging"
# May be negative, as in the published form.
SIGNED = torch.tensor([2.0, 1.0, -0.4, 0.2], dtype=torch.float64)


def form(name, kernel=None):
    return Form(name, kernel or WendlandC2(SUPPORT), 2 * SPACING)


def field_of(comm, velocity, placement="random", move=lambda x: x, dtype=torch.float64):
    slab = SlabDecomposition(comm, LENGTH, CELLS)
    position = torch.from_numpy(release(slab, 3, SIDE**3, placement)["position"])
    return ParticleField(slab, SUPPORT, move(position), velocity(position).to(dtype), dtype)


def largest(comm, error):
    return float(global_max(comm, float(error.abs().max()) if error.numel() else 0.0))


def waves(x):
    return torch.stack([torch.sin(x[:, 1]), torch.sin(x[:, 2]), torch.cos(x[:, 0])], dim=1)


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("name, velocity_error, gradient_error", [
    ("average", 0.3, 0.9), ("kriging", 0.04, 0.18)])
def test_a_smooth_field_and_its_gradient_on_any_number_of_ranks(comm, name, velocity_error, gradient_error):
    """Waves of k = 1, six supports long: an average flattens them by k^2 <x^2>/2, 4 %, and random positions add noise.
    A constant is exact and has no gradient."""
    field = field_of(comm, lambda x: torch.full_like(x, 2.0))
    for velocity, gradient in (form(name).at(field, points) for points in (field.points, field.owned)):
        assert largest(comm, velocity - 2) < 1e-9 and largest(comm, gradient) < 1e-8
    field = field_of(comm, waves)
    velocity, gradient = form(name).at(field, field.points)
    assert largest(comm, velocity - waves(field.points)) < velocity_error
    assert largest(comm, gradient[:, 0, 1] - torch.cos(field.points[:, 1])) < gradient_error
    whole = np.concatenate(comm.allgather(velocity.numpy()))
    alone = comm.Split(comm.rank)
    assert np.abs(form(name).on_grid(field_of(alone, waves)).numpy() - whole).max() < 1e-9
    alone.Free()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, dtype, rounding", [
    *((name, torch.float64, 1e-9) for name in ("published", *FORMS)), ("kriging", torch.float32, 2e-3)])
def test_forms_are_those_of_dense_equations(comm, name, dtype, rounding):
    """At some grid points, against numpy: sums and kriging, one point after the other. The published average, Eq. 6, is
    V sum_j A_j W; A is the velocity minus its mean, which is then added."""
    kernel, field = CubicSpline(SUPPORT), field_of(comm, waves, dtype=dtype)
    if name == "published":
        kernel = HermiteKernel(SUPPORT, SIGNED, torch.zeros(4, dtype=torch.float64), SPACING**3)
    made, points = form("average" if name == "published" else name, kernel), field.points[5::800]
    velocity, gradient = made.at(field, points)
    assert largest(comm, made.on_grid(field)[5::800] - velocity) < rounding
    volume = field.volumes(kernel).double()
    for row, x in enumerate(points):
        away = field.owned - x
        away = away - LENGTH * torch.round(away / LENGTH)
        away, value = away[near := away.norm(dim=1) < SUPPORT].numpy(), waves(field.owned[near]).numpy()
        weight = kernel.value(torch.from_numpy(np.linalg.norm(away, axis=1))).numpy()
        if name == "published":
            mean = waves(field.owned).numpy().mean(axis=0)
            exact, slope = SPACING**3 * weight @ (value - mean) + mean, None
        elif name == "average":
            exact, slope = (volume[near].numpy() * weight) @ value / (volume[near].numpy() @ weight), None
        else:
            weights = solved([0, len(away)], -away, SUPPORT, 2 * SPACING, sited=False)[1]
            exact, slope = weights[0] @ value, (weights[1:4] @ value).T
        assert np.abs(velocity[row].numpy() - exact).max() < rounding
        assert slope is None or np.abs(gradient[row].numpy() - slope).max() < 4 * rounding
    assert velocity.dtype == gradient.dtype == dtype


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, kind", [("average", "clusters"), ("kriging", "clusters"), ("kriging", "planes"),
                                        ("kriging", "pairs")])
def test_voids_and_one_sided_neighbours_give_bounded_results(comm, name, kind):
    """Particles on planes, which do not determine the derivative across, in clusters, and in close pairs."""
    def move(x):
        if kind == "planes":
            return torch.cat([x[:, :2], LENGTH / 4 * torch.round(4 * x[:, 2:] / LENGTH) % LENGTH], 1)
        if kind == "clusters":
            return (LENGTH / 3 * torch.floor(3 * x / LENGTH) + 0.15 * (x % (LENGTH / 3)) + 0.7) % LENGTH
        first = x[::2].repeat_interleave(2, 0)[: len(x)].clone()
        first[1::2] += 1e-5
        return first % LENGTH

    field = field_of(comm, waves, move=move)
    velocity, gradient = form(name).at(field, field.points)
    assert velocity.isfinite().all() and gradient.isfinite().all()
    assert form(name).at(field, field.owned)[1].isfinite().all()
    # The velocity within clusters varies seven times as fast as waves do, and kriging extrapolates it.
    assert velocity.abs().max() < (5 if kind == "clusters" else 3)
    if kind == "clusters":  # the mean velocity where no particle is near
        assert bool((gradient == 0).all(2).all(1).any()) and not bool((velocity == 0).all(1).any())
    # The velocities are not those of a smooth field: about a hundred times their difference over the support.
    assert gradient.abs().max() < 100 * 2 / SUPPORT or name == "average"


@pytest.mark.mpi(1, 3)
def test_averages_replace_kriging_at_points_with_too_many_neighbours(comm, monkeypatch, caplog):
    """Also if only one rank has such points, because averages are collective."""
    field, kriging = field_of(comm, waves), form("kriging")
    points = field.points[:500] if comm.rank == 0 else field.points[:0]
    whole, average = kriging.at(field, points), form("average").at(field, points)
    monkeypatch.setattr("eddies.kernels.kriging.MOST_NEIGHBORS", 60)
    found = kriging.at(field, points)
    replaced = (found[0] == average[0]).all(1)
    for one, kriged, averaged in zip(found, whole, average):
        assert torch.equal(one[replaced], averaged[replaced])
        # Receivers share vectors in another way, so that sums may round differently.
        assert torch.allclose(one[~replaced], kriged[~replaced], rtol=0, atol=1e-9)
    if comm.rank == 0:
        assert 100 < int(replaced.sum()) < 400
        assert f"{int(replaced.sum())} of 500 points" in caplog.text


@pytest.mark.mpi(2)
def test_volumes_by_table_and_their_gradient(comm):
    """Volumes for one table after the other, and their gradient by the weights against a difference."""
    field = field_of(comm, torch.cos)
    for seed in (1, 2):
        network = KernelNetwork(SUPPORT, (5,), seed=seed).double()
        found = field.volumes_by_table(network.table())
        with torch.no_grad():
            expected = field.volumes(network.table())
        assert largest(comm, found.detach() / expected - 1) < 1e-12
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


# ---- averages by torch

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
