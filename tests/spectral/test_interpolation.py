"""Values at points, and sums of splines around them, on slabs."""

import numpy as np
import pytest

from eddies.flow.initial_fields import random_velocity
from eddies.parallel.halo import HaloError
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral import interpolation
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid
from tests.kernels import reference_splines

LENGTH = 5.0


def interpolation_on(comm, kind, precision="float64", cells=19):
    return SplineInterpolation(SpectralGrid(SlabDecomposition(comm, LENGTH, cells), precision), kind)


def points(comm, spline, seed=3):
    """Positions in this rank's slab and up to the margin outside; none on the last of several ranks."""
    slab, random = spline.grid.decomposition, np.random.default_rng([seed, comm.rank])
    count = 0 if comm.rank == comm.size - 1 > 0 else 400
    position = random.uniform(-LENGTH, 2 * LENGTH, (count, 3))
    position[:, 2] = random.uniform(slab.lower - 0.99 * slab.spacing, slab.upper + 0.99 * slab.spacing, count)
    return position


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind, order", [("cubic", 4), ("quintic", 6)])
def test_interpolation_order_against_direct_fourier_sums(comm, kind, order):
    position, errors = np.random.default_rng(6).uniform(0, LENGTH, (20, 3)), []
    for cells in (16, 32):
        spline = interpolation_on(comm, kind, cells=cells)
        grid, modes = spline.grid, random_velocity(spline.grid, 7, 1.0, 1.5)
        waves = [np.exp(1j * sum(k * x for k, x in zip(grid.wavevector, point))) for point in position]
        exact = [(grid.multiplicity * modes * wave).real.sum(axis=(1, 2, 3)) for wave in waves]
        errors.append(np.abs(spline.at(spline.coefficients(modes), position) - exact).max())
    assert np.log2(errors[0] / errors[1]) > order - 0.5


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("kind, precision", [("cubic", "float32"), ("quintic", "float64")])
def test_compiled_and_numpy_are_the_same(comm, monkeypatch, kind, precision):
    spline = interpolation_on(comm, kind, precision)
    position, random = points(comm, spline), np.random.default_rng(comm.rank)
    fields = random.standard_normal((4, *spline.grid.physical_shape)).astype(spline.grid.real)
    values = random.standard_normal((len(position), 4))
    compiled = spline.at(spline.with_ghosts(fields), position), spline.spread(values, spline.around(position))
    monkeypatch.setattr(interpolation, "Splines", lambda library, *given: reference_splines.Splines(*given))
    expected = spline.at(spline.with_ghosts(fields), position), spline.spread(values, spline.around(position))
    assert compiled[0].dtype == np.float64 and compiled[1].dtype == spline.grid.real
    relative = {"float64": 1e-12, "float32": 1e-6}[precision]
    for one, other in zip(compiled, expected):
        assert one.dtype == other.dtype
        assert np.abs(one - other).max(initial=0) <= relative * np.abs(other).max(initial=0)


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
