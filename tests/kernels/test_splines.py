"""Compiled splines against numpy."""

import functools

import numpy as np
import pytest

from eddies.kernels.splines import MisplacedPoint, PaddedPlanes, Splines
from tests.kernels import reference_splines

SPACING, BELOW, ABOVE = 0.3, 3, 4
PRECISIONS = {np.float64: 1e-12, np.float32: 1e-6}
# Degree, components, cells: fewer cells than splines are wide, one chunk of lines, and many of them.
SIZES = [(3, 3, 4), (5, 7, 7), (3, 1, 11), (5, 3, 18), (3, 3, 41)]
CLOUDS = {
    "even": lambda random, n: random.uniform(-2 * n, 3 * n, (1500, 3)),
    "coincident": lambda random, n: np.full((500, 3), 0.37 * n),
    "one cell": lambda random, n: n - 1 + random.uniform(0, 1, (500, 3)),
    "on grid points": lambda random, n: random.integers(-n, 2 * n, (200, 3)).astype(float),
    "none": lambda random, n: np.zeros((0, 3)),
}


def padded_planes(cells):
    """The planes of a slab that is the whole box."""
    return PaddedPlanes(cells, SPACING, -BELOW, BELOW + cells + ABOVE)


def parts(cells, components=3, kind=np.float64):
    """Random planes below, own ones, planes above."""
    return [part.copy() for part in made_once(cells, components, kind)]


@functools.cache
def made_once(cells, components, kind):
    random = np.random.default_rng(1)
    return [random.standard_normal((components, planes, cells, cells)).astype(kind)
            for planes in (BELOW, cells, ABOVE)]


@pytest.mark.parametrize("kind, degree, components, cells", [
    *(("even", *size) for size in SIZES), *((kind, *SIZES[number % 2]) for number, kind in enumerate(CLOUDS) if number)])
def test_values_slopes_and_sums(library, close, kind, degree, components, cells):
    random = np.random.default_rng(2)
    positions = SPACING * CLOUDS[kind](random, cells)
    numpy = reference_splines.Splines(degree, positions, padded_planes(cells))
    compiled = Splines(library, degree, positions, padded_planes(cells))
    for precision, relative in PRECISIONS.items():
        planes, values = parts(cells, components, precision), random.standard_normal((len(positions), components))
        close(compiled.at(planes), numpy.at(planes), relative, 0.1)
        close(compiled.slope(planes, values), numpy.slope(planes, values), relative, 0.1)
        spread, expected = parts(cells, components, precision), parts(cells, components, precision)
        compiled.spread(values, spread)
        numpy.spread(values, expected)
        close(np.concatenate(spread, axis=1), np.concatenate(expected, axis=1), relative, 0.1)


@pytest.mark.parametrize("degree", [3, 5])
def test_spreading_is_the_transpose_and_slopes_are_differences(library, close, degree):
    random, padded = np.random.default_rng(5), padded_planes(18)
    positions, values, planes = random.uniform(0, 5, (500, 3)), random.standard_normal((500, 3)), parts(18)
    compiled, spread = Splines(library, degree, positions, padded), [0 * part for part in planes]
    compiled.spread(values, spread)
    assert sum(np.sum(a * b) for a, b in zip(spread, planes)) == pytest.approx(
        np.sum(values * compiled.at(planes)), rel=1e-12)
    for axis, change in enumerate(1e-6 * np.eye(3)):
        ends = [(values * Splines(library, degree, x, padded).at(planes)).sum(1)
                for x in (positions + change, positions - change)]
        close((ends[0] - ends[1]) / 2e-6, compiled.slope(planes, values)[:, axis], 1e-7)


def test_arrays_of_any_layout(library):
    """The copy of positions that are not contiguous must live until the call has ended."""
    positions = np.random.default_rng(2).uniform(0, 5, (1000, 3)).astype(np.float32)
    expected = Splines(library, 3, positions.astype(float), padded_planes(18)).at(parts(18))
    turned = [np.asfortranarray(part) for part in parts(18)]
    for other in (positions, np.asfortranarray(positions, float)):
        for _ in range(10):
            compiled = Splines(library, 3, other, padded_planes(18))
            assert np.array_equal(compiled.at(parts(18)), expected)
    assert np.array_equal(compiled.at(turned), expected)


@pytest.mark.parametrize("wrong", [np.nan, -np.inf, 1e300, -1e18])
def test_the_first_position_without_a_cell_is_named(library, wrong):
    for axis in range(3):
        positions = np.ones((5000, 3))
        positions[[3777, 4999], axis] = wrong
        with pytest.raises(MisplacedPoint) as raised:
            Splines(library, 3, positions, padded_planes(11))
        assert raised.value.number == 3777


def test_a_position_too_far_from_the_planes_is_refused(library):
    padded = PaddedPlanes(20, 1.0, 8, 7)  # planes 8 ... 14: splines of points from 9 on, and below 13
    for z in (9.0, 12.999, 32.9, -10.9):
        Splines(library, 3, np.array([[0.0, 0.0, z]]), padded)
    for z in (8.999, 13.0):
        with pytest.raises(MisplacedPoint):
            Splines(library, 3, np.array([[0.0, 0.0, z]]), padded)
