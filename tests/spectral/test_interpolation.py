"""Values at points of slabs."""

from contextlib import nullcontext

import numpy as np
import pytest

from eddies.flow.initial_fields import random_velocity
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.interpolation import SplineInterpolation, margin_for, spline_ranks
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH = 5.0


def interpolation_on(comm, kind, cells=19):
    return SplineInterpolation(SpectralGrid(SlabDecomposition(comm, LENGTH, cells)), kind)


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("kind, order", [("cubic", 4), ("quintic", 6)])
def test_interpolation_order_against_direct_fourier_sums(comm, kind, order):
    """At points in the slab and up to the margin outside."""
    errors, random = [], np.random.default_rng(6)
    position = random.uniform(0, LENGTH, (40, 3))
    for cells in (16, 32):
        spline = interpolation_on(comm, kind, cells)
        grid, slab, modes = spline.grid, spline.grid.decomposition, random_velocity(spline.grid, 7, 1.0, 1.5)
        waves = [np.exp(1j * sum(k * x for k, x in zip(grid.wavevector, point))) for point in position]
        exact = global_sum(comm, [(grid.multiplicity * modes * wave).real.sum(axis=(1, 2, 3)) for wave in waves])
        z, reach = position[:, 2], 0.99 * slab.spacing
        near = (z > slab.lower - reach) & (z < slab.upper + reach)
        error = np.abs(spline.at(spline.coefficients(modes), position[near]) - exact[near]).max(initial=0)
        errors.append(float(global_max(comm, error)))
    assert np.log2(errors[0] / errors[1]) > order - 0.5


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind, distance, most", [("cubic", 0.0, 3), ("quintic", 0.0, 2), ("cubic", 1.1, 2)])
def test_the_usable_ranks_are_those_that_splines_accept(comm, kind, distance, most):
    """Nine planes; points are up to 1.1 spacings outside their slab, which takes two more planes."""
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 9))
    margin = margin_for(distance * LENGTH / 9, LENGTH / 9)
    assert spline_ranks(9, kind, margin) == most
    with nullcontext() if comm.size <= most else pytest.raises(HaloError, match=f"at most {most} ranks"):
        SplineInterpolation(grid, kind, margin)


@pytest.mark.mpi(2)
def test_positions_outside_the_ghost_planes_and_not_finite_ones_are_refused(comm):
    spline = interpolation_on(comm, "cubic")
    slab = spline.grid.decomposition
    position = np.full((3, 3), slab.lower)
    position[1, 0] = np.nan
    with pytest.raises(ValueError, match="nan.* is not finite"):
        spline.around(position)
    with pytest.raises(HaloError, match="farther out of its slab"):
        spline.around(np.array([[0, 0, slab.upper + 1.01 * slab.spacing]]))
