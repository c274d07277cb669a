"""Compiled passes over modes against those of numpy, for each instruction set that this processor runs."""

import numpy as np
import pytest

from eddies.kernels.modes import ModePasses
from tests.kernels import reference_modes

SHAPES = [(9, 5, 5), (7, 0, 4), (33, 17, 17), (1, 1, 1)]
VECTORS = ("given", "modes", "direction", "image", "found", "residual")


def passes(library, shape, seed=1, kind=np.float64):
    """Both of them, numpy's in double precision, and arrays for them."""
    random = np.random.default_rng(seed)
    z, y, x = shape
    wavevector = [random.standard_normal(axis) for axis in ((1, 1, x), (1, y, 1), (z, 1, 1))]
    weights = [random.uniform(0, 1, shape) for _ in range(3)]
    weights[1][random.uniform(0, 1, shape) < 0.3] = 0
    weights[1:] = [weight.astype(kind) for weight in weights[1:]]
    given = wavevector, random.integers(1, 3, (1, 1, x)).astype(float), *weights
    vectors = {name: (random.standard_normal((3, *shape)) + 1j * random.standard_normal((3, *shape))).astype(
        np.result_type(kind, np.complex64)) for name in VECTORS}
    return (reference_modes.ModePasses(*given), ModePasses(library, *given),
            random.uniform(0, 1, shape).astype(kind), vectors)


def run(made, inverse, vectors):
    """All passes, one after the other, on copies: the sums and the vectors."""
    given, modes, direction, image, found, residual = (vectors[name].copy() for name in VECTORS)
    made_image, product = made.image(given, modes)
    square = made.descend(0.7, inverse, direction, image, found, residual)
    made.turn(-0.3, inverse, residual, direction)
    return (product, square), (made_image, direction, found, residual)


@pytest.mark.parametrize("kind, of_sums, of_modes", [(np.float64, 1e-13, 1e-14), (np.float32, 1e-7, 1e-6)])
@pytest.mark.parametrize("shape", SHAPES)
def test_passes_are_those_of_numpy(library, shape, kind, of_sums, of_modes):
    numpy, compiled, inverse, vectors = passes(library, shape, kind=kind)
    exact = {name: vector.astype(complex) for name, vector in vectors.items()}
    sums, arrays = run(compiled, inverse, vectors)
    expected_sums, expected = run(numpy, inverse.astype(float), exact)
    scale = 3 * np.prod(shape)
    assert sums == pytest.approx(expected_sums, abs=of_sums * scale)
    for one, other in zip(arrays, expected):
        assert one.dtype == np.result_type(kind, np.complex64)
        assert np.abs(one - other).max(initial=0) <= of_modes * np.abs(other).max(initial=0)


def test_what_is_not_a_number_stays_so(library):
    _, compiled, inverse, vectors = passes(library, (9, 5, 5))
    for name in VECTORS:
        spoiled = {**vectors, name: vectors[name].copy()}
        spoiled[name][1, 4, 2, 3] = np.nan
        sums, arrays = run(compiled, inverse, spoiled)
        assert np.isnan(sums).any() or any(np.isnan(array).any() for array in arrays), name


def test_arrays_of_another_kind_are_refused(library):
    _, compiled, inverse, vectors = passes(library, (9, 5, 5))
    for spoiled in (vectors["given"][:2], vectors["given"].astype(np.complex64), vectors["given"][..., ::-1]):
        with pytest.raises(ValueError, match="is needed"):
            compiled.turn(1.0, inverse, vectors["residual"], spoiled)
    with pytest.raises(ValueError, match="weights of sizes"):
        ModePasses(library, [np.ones(5)] * 3, np.ones(5), *[np.ones((9, 5, 5))] * 3)
