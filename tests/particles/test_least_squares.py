"""Conjugate gradients solve the equations for the modes."""

import numpy as np
import pytest
import torch

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.least_squares import LeastSquares


def equations_on(comm):
    """Equations whose penalty grows with the wavenumber, and 300 points of this rank with values."""
    grid, random = FourierGrid(SlabDecomposition(comm, 5.0, 13), 4), np.random.default_rng(comm.rank)
    inside = (grid.shell > 0) & (grid.shell <= 4)
    slab = grid.decomposition
    position = random.uniform([0, 0, slab.lower], [5, 5, slab.upper], (300, 3))
    equations = LeastSquares(grid, inside, torch.where(inside, 20 * grid.wavenumber_squared, 0.0))
    return equations, grid.points(torch.from_numpy(position)), torch.from_numpy(random.standard_normal((300, 3)))


@pytest.mark.mpi(1, 3)
def test_the_result_solves_the_equations(comm):
    equations, points, values = equations_on(comm)
    right = equations.gathered(values, points)
    count = 300.0 * comm.size
    size = equations.size(right, count)
    found = equations.solve(points, right, count, 1e-24 * size, None, 100)
    assert 5 < found.iterations < 100 and found.left <= 1e-24 * size
    at_points = equations.grid.at(found.modes, points)
    torch.testing.assert_close(found.at_points, at_points, rtol=0, atol=1e-12 * float(at_points.abs().max()))
    applied = equations.gathered(at_points, points) + equations.penalty * found.modes
    assert equations.size(right - applied, count) <= 1e-22 * size
    # Without a gradient the descent takes one pass of the library.
    with torch.no_grad():
        descent = equations.descent(values, points, found.modes)
    recorded = equations.descent(values, points, found.modes)
    torch.testing.assert_close(descent, recorded, rtol=0, atol=1e-13 * float(right.abs().max()))
    # With a given number of iterations the remaining residual is reported.
    found = equations.solve(points, right, count, 0.0, 3, 100)
    applied = equations.gathered(equations.grid.at(found.modes, points), points) + equations.penalty * found.modes
    assert found.iterations == 3 and equations.size(right - applied, count) == pytest.approx(found.left, rel=1e-9)
