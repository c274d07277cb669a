"""Compiled formulas of the fluids against those of numpy, for each instruction set that this processor runs."""

import numpy as np
import pytest

from eddies.kernels.flow import Formulas
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid
from tests.kernels import reference_formulas

TOLERANCE = {"float64": 1e-13, "float32": 3e-6}
SHAPES = [(3, 5, 14), (1, 1, 1), (0, 4, 8)]


class Rank:
    """Stands for a communicator."""

    def __init__(self, rank, size):
        self.rank, self.size = rank, size


def both(library, precision, cells=10, rank=0, ranks=1):
    grid = SpectralGrid(SlabDecomposition(Rank(rank, ranks), 5.0, cells), precision)
    return grid, reference_formulas.Formulas(grid), Formulas(library, grid.wavevector)


def fields(grid, count, shape, apart=0):
    """Fields (count, *shape), each contiguous."""
    size = int(np.prod(shape))
    memory = np.random.default_rng(count).standard_normal((count, size + apart)).astype(grid.real)
    return memory[:, :size].reshape(count, *shape) if apart == 0 else np.ndarray(
        (count, *shape), grid.real, memory, strides=(memory.strides[0], *np.empty(shape, grid.real).strides))


def modes(grid, count, seed=1):
    random = np.random.default_rng(seed)
    shape = (count, *grid.spectral_shape)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(grid.complex)


def factors(grid, count, seed):
    _, lines, width = grid.spectral_shape
    return np.random.default_rng(seed).standard_normal((grid.cutoff + 1, lines, count, width)).astype(grid.real)


def assert_close(found, expected, precision):
    assert found.shape == expected.shape and found.dtype == expected.dtype
    assert np.abs(found - expected).max(initial=0) <= TOLERANCE[precision] * np.abs(expected).max(initial=0)


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("apart", [0, 16])
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("viscosity", [0.0, 0.3])
def test_advection_is_that_of_numpy(library, shape, apart, viscosity, precision):
    grid, numpy, compiled = both(library, precision)
    given, found, expected = fields(grid, 15, shape, apart), fields(grid, 4, shape, apart), fields(grid, 4, shape)
    compiled.advection(given, viscosity, found)
    numpy.advection(given, viscosity, expected)
    assert_close(found, expected, precision)


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_cross_product_is_that_of_numpy(library, shape, precision):
    grid, numpy, compiled = both(library, precision)
    given, found, expected = fields(grid, 6, shape, 8), fields(grid, 3, shape), fields(grid, 3, shape)
    compiled.cross(given, found)
    numpy.cross(given, expected)
    assert_close(found, expected, precision)


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("rank, ranks", [(0, 1), (1, 9), (8, 9)])  # the last has no modes
def test_formulas_on_modes_are_those_of_numpy(library, rank, ranks, precision):
    grid, numpy, compiled = both(library, precision, rank=rank, ranks=ranks)
    vector = modes(grid, 3)
    assert_close(compiled.project(vector), numpy.project(vector), precision)
    for count in (1, 2, 4):
        decays = [(factors(grid, 1, seed), modes(grid, 3, seed)) for seed in range(count)]
        assert_close(compiled.sum_of_decays(decays), numpy.sum_of_decays(decays), precision)
        blocks = [(factors(grid, 5, seed), modes(grid, 4, seed)) for seed in range(count)]
        assert_close(compiled.sum_of_acoustic_blocks(blocks), numpy.sum_of_acoustic_blocks(blocks), precision)


def test_what_is_not_a_number_stays_so(library):
    grid, _, compiled = both(library, "float64")
    out = fields(grid, 4, (2, 3, 4))
    for number in range(15):
        given = fields(grid, 15, (2, 3, 4))
        given[number, 1, 1, 2] = np.nan
        compiled.advection(given, 0.1, out)
        assert np.isnan(out[:, 1, 1, 2]).any() and np.isfinite(out[:, 0]).all()
    for component in range(4):
        state = modes(grid, 4)
        state[component, 1, 2, 0] = np.nan
        result = compiled.sum_of_acoustic_blocks([(factors(grid, 5, 1), modes(grid, 4)), (factors(grid, 5, 1), state)])
        assert np.isnan(result[:, 1, 2, 0]).any() and np.isfinite(result[..., 1:]).all()


def test_arrays_of_another_kind_are_refused(library):
    grid, _, compiled = both(library, "float64")
    with pytest.raises(ValueError, match="15 fields"):
        compiled.advection(fields(grid, 14, (1, 2, 3)), 0.1, fields(grid, 4, (1, 2, 3)))
    with pytest.raises(ValueError, match="fields of contiguous"):
        compiled.cross(fields(grid, 6, (1, 2, 4))[..., ::2], fields(grid, 3, (1, 2, 2)))
    with pytest.raises(ValueError, match="8 values"):
        compiled.cross(fields(grid, 6, (1, 2, 4)), fields(grid, 3, (1, 3, 4)))
    for spoiled in (modes(grid, 2), modes(grid, 3).astype(np.complex64), modes(grid, 3)[..., ::-1]):
        with pytest.raises(ValueError, match="are needed"):
            compiled.project(spoiled)
    with pytest.raises(ValueError, match="contiguous factors"):
        compiled.sum_of_decays([(factors(grid, 5, 1), modes(grid, 3))])
