"""Forms of reconstruction: exact polynomials, gradients, any number of ranks, and particles that leave voids."""

import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.forms import DEGREES, form_of
from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import CubicSpline, HermiteKernel, WendlandC2

LENGTH, SIDE, CELLS = 2 * np.pi, 12, 16
SPACING = LENGTH / SIDE
SUPPORT = SPACING * (60 / (4 / 3 * np.pi)) ** (1 / 3)
FORMS = ("average", *DEGREES, "kriging")
forms = pytest.mark.parametrize("name", FORMS)


def form(name, kernel=None):
    return form_of(name, kernel or WendlandC2(SUPPORT), 2 * SPACING, SPACING**3)


def field_of(comm, velocity, placement="random", move=lambda x: x, dtype=torch.float64):
    slab = SlabDecomposition(comm, LENGTH, CELLS)
    position = torch.from_numpy(release(slab, 3, SIDE, placement)["position"])
    return ParticleField(slab, SUPPORT, move(position), velocity(position).to(dtype), dtype)


def largest(comm, error):
    return float(global_max(comm, float(error.abs().max()) if error.numel() else 0.0))


def waves(x):
    return torch.stack([torch.sin(x[:, 1]), torch.sin(x[:, 2]), torch.cos(x[:, 0])], dim=1)


@pytest.mark.mpi(1, 2, 3)
@forms
def test_a_constant_is_exact_and_has_no_gradient(comm, name):
    field = field_of(comm, lambda x: torch.full_like(x, 2.0))
    made = form(name).of(field)
    for velocity, gradient in (made.at(field.points), made.at_particles()):
        assert largest(comm, velocity - 2) < 1e-9 and largest(comm, gradient) < 1e-8


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, power", [("linear", 1), ("quadratic", 1), ("quadratic", 2)])
def test_polynomials_are_exact_but_for_the_ridge(comm, monkeypatch, name, power):
    """Away from the faces of the box, where they jump. With the ridge to what it is beside the moments of the weight,
    of some 1e-2; without it to rounding."""
    def polynomial(x):
        y = x - LENGTH / 2
        return y if power == 1 else torch.stack([y[:, 0] * y[:, 1], y[:, 2] ** 2, y[:, 1] + y[:, 0] ** 2], dim=1)

    field = field_of(comm, polynomial)
    inside = ((field.points - LENGTH / 2).abs() < LENGTH / 2 - 1.01 * SUPPORT).all(1)
    x = field.points[inside] - LENGTH / 2
    exact = polynomial(field.points[inside])
    slope = torch.zeros(len(x), 3, 3, dtype=torch.float64)
    if power == 1:
        slope += torch.eye(3, dtype=torch.float64)
    else:
        slope[:, 0, 0], slope[:, 0, 1], slope[:, 1, 2] = x[:, 1], x[:, 0], 2 * x[:, 2]
        slope[:, 2, 0], slope[:, 2, 1] = 2 * x[:, 0], 1
    for ridge, error in ((None, 0.03), (0.0, 1e-9)):
        if ridge is not None:
            monkeypatch.setattr("eddies.particles.particle_field.RIDGE", ridge)
        velocity, gradient = form(name).of(field).at(field.points)
        assert (velocity[inside] - exact).abs().max() < error * exact.abs().max()
        assert (gradient[inside] - slope).abs().max() < error * slope.abs().max()


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("name, velocity_error, gradient_error",
                         [("average", 0.3, 0.9), ("linear", 0.16, 0.24), ("quadratic", 0.04, 0.18),
                          ("kriging", 0.04, 0.18)])
def test_a_smooth_field_and_its_gradient_on_any_number_of_ranks(comm, name, velocity_error, gradient_error):
    """Waves of k = 1, six supports long: an average flattens them by k^2 <x^2>/2 of 4 %, with noise of placement."""
    field = field_of(comm, waves)
    velocity, gradient = form(name).of(field).at(field.points)
    assert largest(comm, velocity - waves(field.points)) < velocity_error
    assert largest(comm, gradient[:, 0, 1] - torch.cos(field.points[:, 1])) < gradient_error
    # What single ranks find does not depend on how many there are: sums are over the same neighbours.
    whole = np.concatenate(comm.allgather(velocity.numpy()))
    alone = comm.Split(comm.rank)
    assert np.abs(form(name).of(field_of(alone, waves)).velocity_on_grid().numpy() - whole).max() < 1e-9
    alone.Free()


@pytest.mark.mpi(1)
@forms
def test_the_gradient_is_that_of_the_field(comm, name):
    """Exactly of an average, but for what a difference over 5e-3 misses; of polynomials and kriging, whose weights move
    with the point, to a part of it. Where a neighbour enters or leaves, kriging's field has a small jump, and no
    gradient: a twentieth of the points is left out.
    """
    field, step = field_of(comm, waves, "lattice"), 5e-3
    made = form(name).of(field)
    _, gradient = made.at(field.points)
    points, moved = field.points, {}
    for sign in (-1, 1):
        field.points = points + sign * step * torch.tensor([1.0, 0, 0], dtype=torch.float64)
        if "_around" in field.__dict__:
            del field._around
        moved[sign] = form(name).of(field).at(field.points)[0]
    slope = (moved[1] - moved[-1]) / (2 * step)
    bound = {"average": 5e-3, "linear": 0.2, "quadratic": 0.1, "kriging": 0.2}[name]
    assert torch.quantile((slope - gradient[..., 0]).abs().amax(1), 0.95) < bound


@pytest.mark.mpi(1)
@pytest.mark.parametrize("dtype, rounding", [(torch.float64, 1e-9), (torch.float32, 2e-3)])
@forms
def test_the_library_finds_what_torch_does(comm, monkeypatch, name, dtype, rounding):
    field = field_of(comm, waves, dtype=dtype)
    made = form(name, CubicSpline(SUPPORT)).of(field)
    found = [*made.at(field.points), *made.at_particles()]
    for module in ("particle_field", "kriging"):
        monkeypatch.setattr(f"eddies.particles.{module}.kernels_serve", lambda device: False)
    made = form(name, CubicSpline(SUPPORT)).of(field_of(comm, waves, dtype=dtype))
    for one, other in zip(found, [*made.at(field.points), *made.at_particles()], strict=True):
        assert one.dtype == dtype and (one - other).abs().max() <= rounding * other.abs().max()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", ["planes", "clusters", "pairs"])
@forms
def test_voids_and_neighbours_of_one_side_leave_nothing_without_a_bound(comm, name, kind):
    """Particles on planes, which tell nothing of what lies across, in few places, and in close pairs."""
    def move(x):
        if kind == "planes":
            return torch.cat([x[:, :2], LENGTH / 4 * torch.round(4 * x[:, 2:] / LENGTH) % LENGTH], 1)
        if kind == "clusters":
            return (LENGTH / 3 * torch.floor(3 * x / LENGTH) + 0.15 * (x % (LENGTH / 3)) + 0.7) % LENGTH
        first = x[::2].repeat_interleave(2, 0)[: len(x)].clone()
        first[1::2] += 1e-5
        return first % LENGTH

    field = field_of(comm, waves, move=move)
    made = form(name).of(field)
    velocity, gradient = made.at(field.points)
    assert velocity.isfinite().all() and gradient.isfinite().all()
    # Of clusters, within which the velocity changes seven times as fast as waves do, fits go on a little way outwards.
    assert velocity.abs().max() < (5 if kind == "clusters" else 3)
    if kind == "clusters":  # nothing is told where no particle is
        assert bool((velocity == 0).all(1).any())
    # Of velocities that are not those of a smooth field there: some hundred times their difference over the support.
    assert gradient.abs().max() < 100 * 2 / SUPPORT or name == "average"
    assert made.at_particles()[1].isfinite().all()


@pytest.mark.mpi(1)
def test_kriging_of_too_many_neighbours_says_what_serves_instead(comm, monkeypatch, caplog):
    monkeypatch.setattr("eddies.kernels.kriging.MOST_NEIGHBORS", 40)
    field = field_of(comm, waves)
    found = form("kriging").of(field).velocity_on_grid()
    expected = form("quadratic").of(field).velocity_on_grid()
    many = (found == expected).all(1)
    assert found.isfinite().all() and 0.5 < many.double().mean() < 1
    assert f"of {len(found)} points {int(many.sum())} have too many neighbours" in caplog.text


@pytest.mark.mpi(1, 2)
def test_a_kernel_that_may_be_negative_sums_as_published(comm):
    """Eq. 6: V sum_j A_j W, by torch and the library alike; linear in W, and not divided by a sum of weights."""
    values = torch.tensor([2.0, 1.0, -0.4, 0.2], dtype=torch.float64)
    kernels = [HermiteKernel(SUPPORT, factor * values, torch.zeros(4, dtype=torch.float64), SPACING**3)
               for factor in (1, 2)]
    field = field_of(comm, waves)
    once, twice = (form("average", kernel).of(field) for kernel in kernels)
    assert largest(comm, once.volume - SPACING**3) == 0
    assert largest(comm, 2 * once.velocity_on_grid() - twice.velocity_on_grid()) < 1e-12
    assert largest(comm, once.at(field.points)[0] - once.velocity_on_grid()) < 1e-12
    velocity, gradient = once.at(field.points)
    rows = torch.arange(0, len(field.points), 7)
    for one, other in zip((velocity, gradient), field.on_grid(kernels[0], once.volume, rows)):
        assert largest(comm, one[rows] - other) < 1e-10
