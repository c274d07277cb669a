"""The steps between particles, grid and modes have their adjoints, and formulas of them their gradients."""

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
    forward = inner(comm, function(argument), weights)
    backward = inner(comm, argument, pulled_back(function, argument, weights))
    size = np.sqrt(inner(comm, function(argument), function(argument)) * inner(comm, weights, weights))
    assert forward == pytest.approx(backward, abs=1e-13 * size)
    assert abs(forward) > 1e-8 * size  # not zero on both sides


def assert_slope(comm, function, argument, weights, step=1e-5, error=1e-6):
    """The gradient of <F(x), y> against a central difference along a random direction."""
    change = real(comm, *argument.shape, *([2] if argument.is_complex() else []), seed=2)
    change = torch.view_as_complex(change) if argument.is_complex() else change
    ends = [function(argument + sign * step * change) for sign in (1, -1)]
    expected = inner(comm, pulled_back(function, argument, weights), change)
    assert inner(comm, ends[0] - ends[1], weights) / (2 * step) == pytest.approx(expected, rel=error)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("cells, resolved", [(13, 5), (12, 5)])
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

    # Third derivatives of splines jump at grid planes, which limits the difference.
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
