"""The steps between particles, grid and modes have their adjoints, and formulas agree with plain transforms."""

import numpy as np
import pytest
import torch

from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid

LENGTH, CELLS, RESOLVED = 5.0, 13, 5  # slabs of unequal thickness on two and three ranks
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


def grid_on(comm, cells=CELLS, resolved=RESOLVED):
    return FourierGrid(SlabDecomposition(comm, LENGTH, cells), resolved)


def real(comm, *shape, seed=0):
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(97 * seed + comm.rank))


def modes_like(comm, grid, components, seed=0):
    """Random complex numbers as modes; those with kx = 0 are not Hermitian."""
    return torch.view_as_complex(real(comm, components, *grid.spectral.spectral_shape, 2, seed=seed))


def points(comm, grid, seed=3):
    """Positions in this rank's slab and just outside it; a different number on each rank."""
    slab, random = grid.decomposition, np.random.default_rng(seed + comm.rank)
    position = random.uniform(0, LENGTH, (11 + 3 * comm.rank, 3))
    position[:, 2] = random.uniform(slab.lower - 0.9 * grid.reach, slab.upper + 0.9 * grid.reach, len(position))
    return torch.from_numpy(position)


def inner(comm, a, b):
    """Sum over ranks of the real parts of a conj(b), on every rank."""
    return float(global_sum(comm, float((a * b.conj()).real.sum().detach())))


def pulled_back(function, argument, weights):
    """Gradient of <function(argument), weights>."""
    argument = argument.detach().clone().requires_grad_()
    result = function(argument)
    if not result.requires_grad:
        return torch.zeros_like(argument)
    return torch.autograd.grad(result, argument, weights)[0]


def assert_adjoint(comm, function, argument, weights):
    """<F x, y> = <x, F* y> for a linear function."""
    found = inner(comm, function(argument), weights)
    expected = inner(comm, argument, pulled_back(function, argument, weights))
    size = np.sqrt(inner(comm, function(argument), function(argument)) * inner(comm, weights, weights))
    assert found == pytest.approx(expected, abs=1e-13 * size)
    assert abs(found) > 1e-8 * size  # not zero on both sides


def assert_slope(comm, function, argument, weights, step=1e-5, error=1e-6):
    """The gradient of <F(x), y> against a central difference along a random direction."""
    change = real(comm, *argument.shape, *([2] if argument.is_complex() else []), seed=2)
    change = torch.view_as_complex(change) if argument.is_complex() else change
    ends = [function(argument + sign * step * change) for sign in (1, -1)]
    expected = inner(comm, pulled_back(function, argument, weights), change)
    assert inner(comm, ends[0] - ends[1], weights) / (2 * step) == pytest.approx(expected, rel=error)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells, resolved", [(13, 5), (12, 5), (9, 4)])
def test_adjoints_of_the_transforms(comm, cells, resolved):
    grid = grid_on(comm, cells, resolved)
    fields, modes = real(comm, 2, *grid.spectral.physical_shape), modes_like(comm, grid, 2)
    assert_adjoint(comm, grid.to_modes, fields, modes)
    assert_adjoint(comm, grid.to_fields, modes, fields)


@pytest.mark.mpi(1, 2, 3)
def test_adjoints_of_interpolation_and_spreading(comm):
    grid = grid_on(comm)
    position = points(comm, grid)
    values, modes = real(comm, len(position), 2), modes_like(comm, grid, 2)
    assert_adjoint(comm, lambda modes: grid.at(modes, grid.points(position)), modes, values)
    assert_adjoint(comm, lambda values: grid.spread(values, grid.points(position)), values, modes)
    # They are each other's, except for the number of points and the multiplicity of modes.
    scaled = modes / (grid.multiplicity * CELLS**3)
    assert inner(comm, grid.spread(values, grid.points(position)), modes) == pytest.approx(
        inner(comm, values, grid.at(scaled, grid.points(position))), rel=1e-12)
    # Third derivatives of splines jump at grid planes, which limits the difference.
    assert_slope(comm, lambda x: grid.at(modes, grid.points(x)), position, values)
    assert_slope(comm, lambda x: grid.spread(values, grid.points(x)), position, modes)


@pytest.mark.mpi(1, 2, 3)
def test_a_formula_of_all_steps_is_differentiated_automatically(comm):
    """Spread, project, multiply at grid points, stress with its pressure, interpolate: by values and positions."""
    grid = grid_on(comm)
    position = points(comm, grid)
    values, weights = real(comm, len(position), 3), real(comm, len(position), 4, seed=1)

    def force(values, position):
        velocity = grid.solenoidal(grid.within(grid.spread(values, grid.points(position))))
        slopes = grid.slopes(velocity)
        hidden = grid.hidden_stress(grid.products(slopes, slopes))
        return grid.at(torch.cat([hidden.force_modes, hidden.pressure_modes[None]]), grid.points(position))

    assert_slope(comm, lambda x: force(x, position), values, weights)
    assert_slope(comm, lambda x: force(values, x), position, weights)


@pytest.mark.mpi(1, 2, 3)
def test_squares_are_products_and_their_gradient(comm):
    grid = grid_on(comm, 18, 4)
    modes, weights = modes_like(comm, grid, 3), modes_like(comm, grid, 6)

    def products(modes):
        fields = grid.to_fields(modes)
        return grid.within(grid.products(fields, fields))

    torch.testing.assert_close(grid.squares(modes), products(modes), rtol=0, atol=1e-12)
    back = [pulled_back(function, modes, weights) for function in (grid.squares, products)]
    torch.testing.assert_close(*back, rtol=0, atol=1e-10 * float(back[1].abs().max()))
    assert_slope(comm, grid.squares, modes, weights, step=1e-3, error=1e-9)  # a difference of squares is exact


# ---- against numpy, on one array of the whole box


class Whole:
    """Fields of the whole box (c, z, y, x) with plain transforms, the same on all ranks."""

    def __init__(self, cells=CELLS):
        k = np.fft.fftfreq(cells, 1 / cells) * (2 * np.pi / LENGTH)
        self.wave = np.stack(np.meshgrid(k, k, k, indexing="ij")[::-1])
        self.squared = (self.wave**2).sum(0)
        self.inverse = np.divide(1, self.squared, out=np.zeros_like(self.squared), where=self.squared > 0)

    def modes(self, fields):
        return np.fft.fftn(fields, axes=(-3, -2, -1))

    def fields(self, modes):
        return np.fft.ifftn(modes, axes=(-3, -2, -1)).real

    def cut(self, fields, highest=RESOLVED):
        """The part with |k_i| <= highest."""
        kept = (np.abs(self.wave) <= (highest + 0.5) * 2 * np.pi / LENGTH).all(0)
        return self.fields(kept * self.modes(fields))

    def random(self, components, seed=5, highest=RESOLVED):
        return self.cut(np.random.default_rng(seed).standard_normal((components, *self.squared.shape)), highest)


def own(grid, whole):
    """This rank's planes of fields (..., z, y, x) of the whole box."""
    planes = slice(grid.decomposition.start, grid.decomposition.stop)
    return torch.from_numpy(np.ascontiguousarray(whole[..., planes, :, :]))


def assert_fields(grid, found, expected):
    """Modes, or fields, against fields of the whole box."""
    if found.is_complex():
        found = grid.to_fields(found if found.dim() == 4 else found[None])
    expected = own(grid, expected if expected.ndim > 3 else expected[None]).numpy()
    assert np.allclose(found, expected, rtol=0, atol=1e-12 * np.abs(expected).max(initial=0.1))


MATRIX = np.array([[0, 3, 4], [3, 1, 5], [4, 5, 2]])  # places of xx, yy, zz, xy, xz, yz


@pytest.mark.mpi(1, 2, 3)
def test_derivatives_projection_and_pressure_are_those_of_plain_transforms(comm):
    grid, whole = grid_on(comm), Whole()
    vector, stress = whole.random(3), whole.random(6, seed=6)
    modes, spectral = grid.to_modes(own(grid, vector)), whole.modes(vector)
    assert_fields(grid, grid.gradient(modes[0]), whole.fields(1j * whole.wave * spectral[0]))
    assert_fields(grid, grid.divergence(modes), whole.fields(1j * (whole.wave * spectral).sum(0)))
    along = (whole.wave * spectral).sum(0) * whole.inverse
    assert_fields(grid, grid.solenoidal(modes), whole.fields(spectral - whole.wave * along))
    assert_fields(grid, grid.slopes(modes), np.stack([whole.fields(1j * whole.wave * each) for each in spectral]))
    tau = whole.modes(stress)[MATRIX]
    divergence = (1j * whole.wave[None] * tau).sum(1)
    pressure = (1j * whole.wave * divergence).sum(0) * whole.inverse
    stress_modes = grid.to_modes(own(grid, stress))
    assert_fields(grid, grid.stress_divergence(stress_modes), whole.fields(divergence))
    hidden = grid.hidden_stress(stress_modes)
    assert_fields(grid, hidden.pressure_modes, whole.fields(pressure))
    assert_fields(grid, hidden.force_modes, whole.fields(-1j * whole.wave * pressure - divergence))
    kept = whole.squared <= (RESOLVED * 2 * np.pi / LENGTH) ** 2 * (1 + 1e-9)
    assert_fields(grid, grid.within(modes), whole.fields(kept * spectral))


@pytest.mark.mpi(1, 2, 3)
def test_products_of_fields_at_the_grid_points(comm):
    cells = 18  # products of modes up to 4 are free of aliasing
    grid, whole = grid_on(comm, cells, 4), Whole(cells)
    first, second = whole.random(3, highest=4), whole.random(3, seed=8, highest=4)
    both = torch.stack([own(grid, first), own(grid, second)], dim=1)  # the second index is summed over
    for fields, parts in ((own(grid, first), (first,)), (both, (first, second))):
        expected = [whole.cut(sum(part[i] * part[j] for part in parts), 4) for i, j in PAIRS]
        assert_fields(grid, grid.products(fields, fields), np.stack(expected))
