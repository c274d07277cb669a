"""Compiled passes over modes against numpy."""

import numpy as np
import pytest

from eddies.kernels.modes import ModePasses

VECTORS = ("given", "modes", "direction", "applied", "solution", "residual")


def set_up(shape, kind=np.float64):
    """The passes, their weights, an array for the preconditioner, and vectors by name."""
    random, (z, y, x) = np.random.default_rng(1), shape
    wavevector = [random.standard_normal(axis) for axis in ((1, 1, x), (1, y, 1), (z, 1, 1))]
    inverse_squared, scale, penalty, inverse = (random.uniform(0, 1, shape).astype(kind) for _ in range(4))
    scale[random.uniform(0, 1, shape) < 0.3] = 0
    weights = wavevector, random.integers(1, 3, (1, 1, x)).astype(float), inverse_squared, scale, penalty
    vectors = {name: (random.standard_normal((3, *shape)) + 1j * random.standard_normal((3, *shape))).astype(
        np.result_type(kind, np.complex64)) for name in VECTORS}
    return ModePasses(*weights), weights, inverse, vectors


def run(passes, inverse, vectors):
    """All passes on copies of the vectors: the inner products, and the results by name."""
    own = {name: vector.copy() for name, vector in vectors.items()}
    made, product = passes.apply(own["given"], own["modes"])
    square = passes.descend(0.7, inverse, own["direction"], own["applied"], own["solution"], own["residual"])
    passes.update_direction(-0.3, inverse, own["residual"], own["direction"])
    return (product, square), {"made": made, **{name: own[name] for name in ("direction", "solution", "residual")}}


@pytest.mark.parametrize("kind, of_sums, of_modes", [(np.float64, 1e-13, 1e-14), (np.float32, 1e-7, 1e-6)])
@pytest.mark.parametrize("shape", [(7, 0, 4), (33, 17, 17), (1, 1, 1)])
def test_one_iteration(library, close, shape, kind, of_sums, of_modes):
    passes, weights, inverse, vectors = set_up(shape, kind)
    wavevector, multiplicity, inverse_squared, scale, penalty = weights
    sums, results = run(passes, inverse, vectors)
    exact = {name: vector.astype(complex) for name, vector in vectors.items()}
    scaled = scale * exact["given"]
    along = sum(k * u for k, u in zip(wavevector, scaled)) * inverse_squared
    made = scaled - np.stack([k * along for k in wavevector]) + penalty * exact["modes"]
    residual = exact["residual"] - 0.7 * exact["applied"]
    expected = {"made": made, "solution": exact["solution"] + 0.7 * exact["direction"], "residual": residual,
                "direction": inverse * residual - 0.3 * exact["direction"]}
    for name, vector in expected.items():
        assert results[name].dtype == vectors["given"].dtype
        close(results[name], vector, of_modes)
    products = [np.sum(multiplicity * (one * other.conj()).real)
                for one, other in ((made, exact["modes"]), (residual, inverse * residual))]
    assert sums == pytest.approx(products, abs=of_sums * 3 * np.prod(shape))
