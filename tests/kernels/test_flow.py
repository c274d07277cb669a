"""Compiled formulas of the fluids against numpy."""

from types import SimpleNamespace

import numpy as np
import pytest

from eddies.kernels.flow import Formulas
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid

TOLERANCE = {"float64": 1e-13, "float32": 3e-6}
SHAPES = [(3, 5, 14), (0, 4, 8)]


def set_up(precision, cells=10, rank=0, ranks=1):
    grid = SpectralGrid(SlabDecomposition(SimpleNamespace(rank=rank, size=ranks), 5.0, cells), precision)
    return grid, Formulas(grid.wavevector)


def fields(count, shape, precision="float64", apart=0):
    """Random fields (count, *shape), each contiguous, the next one `apart` numbers behind it."""
    size = int(np.prod(shape))
    memory = np.random.default_rng(count).standard_normal((count, size + apart)).astype(precision)
    return np.ndarray((count, *shape), precision, memory,
                      strides=(memory.strides[0], *np.empty(shape, precision).strides))


def modes(grid, count, seed=1):
    random, shape = np.random.default_rng(seed), (count, *grid.spectral_shape)
    return (random.standard_normal(shape) + 1j * random.standard_normal(shape)).astype(grid.complex)


def factors(grid, count, seed):
    _, lines, width = grid.spectral_shape
    return np.random.default_rng(seed).standard_normal((grid.cutoff + 1, lines, count, width)).astype(grid.real)


def at_all_kz(factors):
    """Factors (kz >= 0, ky, n, kx) at kz = 0 ... K, -K ... -1: (n, kz, ky, kx)."""
    return np.moveaxis(np.concatenate([factors, factors[:0:-1]]), 2, 0)


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("shape", SHAPES)
def test_products_at_grid_points(library, close, shape, precision):
    """-u.grad u + 2 nu (S - 1/3 div u).grad s, -u.grad s, and u x omega."""
    _, compiled = set_up(precision)
    for viscosity, apart in ((0.0, 16), (0.3, 0), (0.3, 16)):
        given, found = fields(15, shape, precision, apart), fields(4, shape, precision, apart)
        compiled.advection(given, viscosity, found)
        u, gradient = given[:3].astype(float), given[3:].reshape(3, 4, *shape).astype(float)
        strain = (gradient[:, :3] + np.swapaxes(gradient[:, :3], 0, 1)) / 2
        deviator = strain - np.einsum("jj...->...", strain) / 3 * np.eye(3)[(...,) + (None,) * len(shape)]
        expected = -np.einsum("j...,ji...->i...", u, gradient)
        expected[:3] += 2 * viscosity * np.einsum("ij...,j...->i...", deviator, gradient[:, 3])
        close(found, expected, TOLERANCE[precision])
    given, found = fields(6, shape, precision, 8), fields(3, shape, precision)
    compiled.cross(given, found)
    close(found, np.cross(given[:3], given[3:], axis=0), TOLERANCE[precision])


@pytest.mark.parametrize("precision", TOLERANCE)
@pytest.mark.parametrize("rank, ranks", [(0, 1), (1, 9), (8, 9)])  # the last rank has no modes
def test_operators_on_modes(library, close, rank, ranks, precision):
    grid, compiled = set_up(precision, rank=rank, ranks=ranks)
    close(compiled.project(modes(grid, 3)), grid.solenoidal(modes(grid, 3)), TOLERANCE[precision])
    for count in (1, 4):
        decays = [(factors(grid, 1, seed), modes(grid, 3, seed)) for seed in range(count)]
        close(compiled.sum_of_decays(decays), sum(at_all_kz(factor) * state for factor, state in decays),
              TOLERANCE[precision])
        blocks = [(factors(grid, 5, seed), modes(grid, 4, seed)) for seed in range(count)]
        expected = np.zeros_like(blocks[0][1])
        for factor, state in blocks:
            transverse, excess, elastic, identity, coupling = at_all_kz(factor)
            dotted, sigma = grid.along_wavevector(state[:3]), -1j * state[3]
            along = excess * dotted + elastic * sigma
            expected[:3] += [transverse * u + k * along for k, u in zip(grid.wavevector, state)]
            expected[3] += 1j * (identity * sigma - coupling * dotted)
        close(compiled.sum_of_acoustic_blocks(blocks), expected, TOLERANCE[precision])


def test_nan_stays_nan(library):
    grid, compiled = set_up("float64")
    out = fields(4, (2, 3, 4))
    for number in range(15):
        given = fields(15, (2, 3, 4))
        given[number, 1, 1, 2] = np.nan
        compiled.advection(given, 0.1, out)
        assert np.isnan(out[:, 1, 1, 2]).any() and np.isfinite(out[:, 0]).all()
    for component in range(4):
        state = modes(grid, 4)
        state[component, 1, 2, 0] = np.nan
        result = compiled.sum_of_acoustic_blocks([(factors(grid, 5, 1), modes(grid, 4)), (factors(grid, 5, 1), state)])
        assert np.isnan(result[:, 1, 2, 0]).any() and np.isfinite(result[..., 1:]).all()
