"""The linear steps between particles, grid and modes have the adjoints that they say; formulas are those of numpy."""

import numpy as np
import pytest
import torch

from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid

LENGTH, CELLS, RESOLVED = 5.0, 13, 5  # slabs of unequal thickness on two and three ranks


def grid_on(comm, cells=CELLS, resolved=RESOLVED):
    return FourierGrid(SlabDecomposition(comm, LENGTH, cells), resolved)


def real(comm, *shape, seed=0):
    return torch.randn(shape, dtype=torch.float64, generator=torch.Generator().manual_seed(97 * seed + comm.rank))


def modes_like(comm, grid, components, seed=0):
    """Complex numbers in place of modes, those with kx = 0 not Hermitian."""
    shape = components, *grid.spectral.spectral_shape, 2
    return torch.view_as_complex(real(comm, *shape, seed=seed))


def fields_like(comm, grid, components, seed=0):
    return real(comm, components, *grid.spectral.physical_shape, seed=seed)


def points(comm, grid, seed=3):
    """Positions in this rank's slab and just outside of it; another number on each rank."""
    slab, random = grid.decomposition, np.random.default_rng(seed + comm.rank)
    position = random.uniform(0, LENGTH, (11 + 3 * comm.rank, 3))
    position[:, 2] = random.uniform(slab.lower - 0.9 * grid.reach, slab.upper + 0.9 * grid.reach, len(position))
    return torch.from_numpy(position)


def inner(comm, a, b):
    """Sum over ranks of the real parts of a conj(b), on every rank."""
    return float(global_sum(comm, float((a * b.conj()).real.sum().detach())))


def pulled_back(function, argument, weights):
    """What `weights` on the output of a function become on its argument."""
    argument = argument.detach().clone().requires_grad_()
    result = function(argument)
    if not result.requires_grad:
        return torch.zeros_like(argument)
    return torch.autograd.grad(result, argument, weights)[0]


def assert_adjoint(comm, function, argument, weights):
    """<F x, y> = <x, F* y> of a linear function."""
    found = inner(comm, function(argument), weights)
    expected = inner(comm, argument, pulled_back(function, argument, weights))
    size = np.sqrt(inner(comm, function(argument), function(argument)) * inner(comm, weights, weights))
    assert found == pytest.approx(expected, abs=1e-13 * size)
    assert abs(found) > 1e-8 * size  # zero on both sides would show nothing


def slope(comm, function, argument, change, weights, step):
    """Central difference of <F(x), y> along a change of x."""
    ends = [function(argument + sign * step * change) for sign in (1, -1)]
    return inner(comm, ends[0] - ends[1], weights) / (2 * step)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells, resolved", [(13, 5), (12, 5), (9, 4)])
def test_adjoints_of_the_transforms(comm, cells, resolved):
    grid = grid_on(comm, cells, resolved)
    assert_adjoint(comm, grid.to_modes, fields_like(comm, grid, 2), modes_like(comm, grid, 2))
    assert_adjoint(comm, grid.to_fields, modes_like(comm, grid, 2), fields_like(comm, grid, 2))


@pytest.mark.mpi(1, 2, 3)
def test_adjoints_of_interpolation_and_spreading(comm):
    grid = grid_on(comm)
    position = points(comm, grid)
    values = real(comm, len(position), 2)
    modes = modes_like(comm, grid, 2)
    assert_adjoint(comm, lambda modes: grid.at(modes, position), modes, values)
    assert_adjoint(comm, lambda values: grid.spread(values, position), values, modes)
    # Up to the number of points and the multiplicity of modes they are each other's.
    scaled = modes / (grid.multiplicity * CELLS**3)
    assert inner(comm, grid.spread(values, position), modes) == pytest.approx(
        inner(comm, values, grid.at(scaled, position)), rel=1e-12)


@pytest.mark.mpi(1, 2, 3)
def test_slopes_of_interpolation_and_spreading_in_the_positions(comm):
    grid = grid_on(comm)
    position = points(comm, grid)
    values, modes = real(comm, len(position), 2), modes_like(comm, grid, 2)
    change = real(comm, len(position), 3, seed=1)
    for function, weights in ((lambda x: grid.at(modes, x), values), (lambda x: grid.spread(values, x), modes)):
        expected = inner(comm, pulled_back(function, position, weights), change)
        # The error of a central difference: step^2 of the third derivative, which jumps at grid planes.
        assert slope(comm, function, position, change, weights, 1e-5) == pytest.approx(expected, rel=1e-7)


@pytest.mark.mpi(1, 2, 3)
def test_a_formula_of_all_steps_differentiates_itself(comm):
    """Spread, project, multiply at grid points, stress with its pressure, interpolate: in values and positions."""
    grid = grid_on(comm)
    position = points(comm, grid)
    values, weights = real(comm, len(position), 3), real(comm, len(position), 4, seed=1)

    def force(values, position):
        velocity = grid.solenoidal(grid.within(grid.spread(values, position)))
        slopes = grid.slopes(velocity)
        hidden = grid.hidden_stress(grid.products(slopes, slopes))
        return grid.at(torch.cat([hidden.force_modes, hidden.pressure_modes[None]]), position)

    for argument, function in ((values, lambda x: force(x, position)), (position, lambda x: force(values, x))):
        change = real(comm, *argument.shape, seed=2)
        expected = inner(comm, pulled_back(function, argument, weights), change)
        assert slope(comm, function, argument, change, weights, 1e-5) == pytest.approx(expected, rel=1e-6)


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

    def random(self, components, seed=5, highest=RESOLVED):
        """Fields of the modes |k_i| <= highest."""
        noise = np.random.default_rng(seed).standard_normal((components, *self.squared.shape))
        kept = (np.abs(self.wave) <= (highest + 0.5) * 2 * np.pi / LENGTH).all(0)
        return self.fields(kept * self.modes(noise))


def own(grid, whole):
    """This rank's planes of fields of the whole box."""
    return torch.from_numpy(np.ascontiguousarray(whole[:, grid.decomposition.start : grid.decomposition.stop]))


def assert_fields(grid, modes, expected):
    found = grid.to_fields(modes if modes.dim() == 4 else modes[None])
    assert np.allclose(found, own(grid, np.atleast_3d(expected).reshape(-1, *expected.shape[-3:])), rtol=0,
                       atol=1e-12 * np.abs(expected).max())


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
    assert np.abs(grid.divergence(grid.solenoidal(modes))).max() < 1e-13 if modes.numel() else True
    slopes = np.stack([whole.fields(1j * whole.wave * component) for component in spectral])
    found = grid.slopes(modes)
    for i in range(3):
        assert np.allclose(found[i], own(grid, slopes[i]), rtol=0, atol=1e-12 * np.abs(slopes).max())
    tau = whole.modes(stress)[MATRIX]
    divergence = (1j * whole.wave[None] * tau).sum(1)
    pressure = (1j * whole.wave * divergence).sum(0) * whole.inverse
    stress_modes = grid.to_modes(own(grid, stress))
    assert_fields(grid, grid.stress_divergence(stress_modes), whole.fields(divergence))
    assert_fields(grid, grid.pressure_of(stress_modes), whole.fields(pressure))
    hidden = grid.hidden_stress(stress_modes)
    assert_fields(grid, hidden.pressure_modes, whole.fields(pressure))
    assert_fields(grid, hidden.force_modes, whole.fields(-1j * whole.wave * pressure - divergence))


@pytest.mark.mpi(1, 2, 3)
def test_products_of_fields_at_the_grid_points(comm):
    cells = 18  # products of the modes up to 4 are free of aliasing
    grid, whole = grid_on(comm, cells, 4), Whole(cells)
    first, second = whole.random(3, highest=4), whole.random(3, seed=8, highest=4)
    kept = (np.abs(whole.wave) <= 4.5 * 2 * np.pi / LENGTH).all(0)

    def cut(field):
        return whole.fields(kept * whole.modes(field))

    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    found = grid.products(own(grid, first), own(grid, first))
    assert_fields(grid, found, np.stack([cut(first[i] * first[j]) for i, j in pairs]))
    # Of matrices, the second index is summed over.
    both = torch.stack([own(grid, first), own(grid, second)], dim=1)
    found = grid.products(both, both)
    assert_fields(grid, found, np.stack([cut(first[i] * first[j] + second[i] * second[j]) for i, j in pairs]))


@pytest.mark.mpi(1, 2, 3)
def test_squares_are_products_that_keep_no_fields_and_differentiate_as_these(comm):
    grid = grid_on(comm, 18, 4)
    modes = modes_like(comm, grid, 3)
    change, weights = modes_like(comm, grid, 3), modes_like(comm, grid, 6)

    def products(modes):
        fields = grid.to_fields(modes)
        return grid.within(grid.products(fields, fields))

    torch.testing.assert_close(grid.squares(modes), products(modes), rtol=0, atol=1e-12)
    back = [pulled_back(function, modes, weights) for function in (grid.squares, products)]
    torch.testing.assert_close(*back, rtol=0, atol=1e-10 * float(back[1].abs().max()))
    # and by differences, which for squares have no error but that of rounding
    expected = inner(comm, back[0], change)
    assert slope(comm, grid.squares, modes, change, weights, 1e-3) == pytest.approx(expected, rel=1e-9)


@pytest.mark.mpi(1, 2, 3)
def test_only_modes_in_the_sphere_are_kept(comm):
    grid, whole = grid_on(comm), Whole()
    vector = whole.random(3)
    kept = whole.squared <= (RESOLVED * 2 * np.pi / LENGTH) ** 2 * (1 + 1e-9)
    assert_fields(grid, grid.within(grid.to_modes(own(grid, vector))), whole.fields(kept * whole.modes(vector)))


@pytest.mark.mpi(1, 2, 3)
def test_values_of_a_wave_at_positions_to_the_accuracy_of_splines(comm):
    """Cubic splines between 13 points of a wave of two periods: (k dx)^4 / 720 and a little more of a percent."""
    grid = grid_on(comm)
    x, y, z = grid.spectral.coordinates()
    k = 2 * 2 * np.pi / LENGTH
    wave = np.broadcast_to(np.sin(k * x) * np.cos(k * z / 2), grid.spectral.physical_shape)
    position = points(comm, grid)
    found = grid.at(grid.to_modes(torch.from_numpy(wave[None].copy())), position)[:, 0]
    expected = torch.sin(k * position[:, 0]) * torch.cos(k * position[:, 2] / 2)
    assert (found - expected).abs().max() < 4e-3
