"""Compiled splines against those of numpy, for each instruction set that this processor runs."""

import functools

import numpy as np
import pytest

from eddies.kernels.splines import MisplacedPoint, PaddedPlanes, Splines
from tests.kernels import reference_splines

SPACING, BELOW, ABOVE = 0.3, 3, 4
# With fewer cells than splines are wide and than columns are moved together, with one chunk of lines and with many.
CELLS = (4, 7, 11, 18, 41)
# To which sums in each precision are those of double precision.
PRECISIONS = {np.float64: 1e-12, np.float32: 1e-6}
CLOUDS = {
    "even": lambda random, n: random.uniform(-2 * n, 3 * n, (1500, 3)),
    "coincident": lambda random, n: np.full((500, 3), 0.37 * n),
    "one cell": lambda random, n: n - 1 + random.uniform(0, 1, (500, 3)),
    "on grid points": lambda random, n: random.integers(-n, 2 * n, (200, 3)).astype(float),
    "one": lambda random, n: random.uniform(0, n, (1, 3)),
    "none": lambda random, n: np.zeros((0, 3)),
}


def padded_planes(cells):
    """Of a slab that is the whole box."""
    return PaddedPlanes(cells, SPACING, -BELOW, BELOW + cells + ABOVE)


def parts(cells, components=3, seed=1, kind=np.float64):
    """Planes below, own ones, planes above."""
    return [part.copy() for part in made_once(cells, components, seed, kind)]


@functools.cache  # making them takes longer than what they are made for
def made_once(cells, components, seed, kind):
    """Random planes below, own ones, planes above."""
    random = np.random.default_rng(seed)
    return [random.standard_normal((components, planes, cells, cells)).astype(kind)
            for planes in (BELOW, cells, ABOVE)]


def both(library, degree, positions, cells):
    padded = padded_planes(cells)
    return reference_splines.Splines(degree, positions, padded), Splines(library, degree, positions, padded)


def assert_close(found, expected, relative=1e-12):
    """Where what is summed is of size 1."""
    assert found.shape == expected.shape and found.dtype == expected.dtype
    assert np.abs(found - expected).max(initial=0) <= relative * np.abs(expected).max(initial=0.1)


@pytest.mark.parametrize("kind", CLOUDS)
@pytest.mark.parametrize("cells", CELLS)
@pytest.mark.parametrize("precision", PRECISIONS)
@pytest.mark.parametrize("degree, components", [(3, 3), (3, 1), (5, 3), (5, 7)])
def test_values_slopes_and_sums_are_those_of_numpy(library, degree, components, cells, kind, precision):
    random, relative = np.random.default_rng(2), PRECISIONS[precision]
    positions = SPACING * CLOUDS[kind](random, cells)
    numpy, compiled = both(library, degree, positions, cells)
    planes, values = parts(cells, components, kind=precision), random.standard_normal((len(positions), components))
    assert_close(compiled.at(planes), numpy.at(planes), relative)
    assert_close(compiled.slope(planes, values), numpy.slope(planes, values), relative)
    found, expected = parts(cells, components, kind=precision), parts(cells, components)
    compiled.spread(values, found)
    numpy.spread(values, expected)
    assert_close(np.concatenate(found, axis=1).astype(float), np.concatenate(expected, axis=1), relative)


@pytest.mark.parametrize("degree", [3, 5])
def test_views_of_planes(library, degree):
    positions = np.random.default_rng(2).uniform(0, 5, (3000, 3))
    compiled = both(library, degree, positions, 18)[1]
    turned = [np.asfortranarray(part) for part in parts(18)]
    assert np.array_equal(compiled.at(turned), compiled.at(parts(18)))
    with pytest.raises(ValueError, match="contiguous ones in one precision"):
        compiled.spread(np.zeros((3000, 3)), turned)
    with pytest.raises(ValueError, match="contiguous ones in one precision"):
        compiled.spread(np.zeros((3000, 3)), [*parts(18)[:2], parts(18, kind=np.float32)[2]])


@pytest.mark.parametrize("turned", [np.asfortranarray, np.float32])
def test_positions_that_lie_otherwise(library, turned):
    # What they are copied to once was given back before it was read, and held other numbers now and then.
    positions = turned(np.random.default_rng(2).uniform(0, 5, (1000, 3)).astype(np.float32).astype(float))
    expected = both(library, 3, np.array(positions, np.float64, order="C"), 18)[1].at(parts(18))
    for _ in range(20):
        assert np.array_equal(both(library, 3, positions, 18)[1].at(parts(18)), expected)


@pytest.mark.parametrize("degree", [3, 5])
def test_spreading_is_the_transpose_of_interpolation(library, degree):
    random = np.random.default_rng(5)
    _, compiled = both(library, degree, random.uniform(0, 5, (4000, 3)), 18)
    values, planes, spread = random.standard_normal((4000, 3)), parts(18), [0 * part for part in parts(18)]
    compiled.spread(values, spread)
    expected = np.sum(values * compiled.at(planes))
    assert sum(np.sum(a * b) for a, b in zip(spread, planes)) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("degree", [3, 5])
def test_slopes_are_those_of_finite_differences(library, degree):
    random = np.random.default_rng(5)
    positions, factors, planes = random.uniform(0, 5, (500, 3)), random.standard_normal((500, 3)), parts(18)
    slope = both(library, degree, positions, 18)[1].slope(planes, factors)
    for axis, change in enumerate(1e-6 * np.eye(3)):
        ends = [(factors * both(library, degree, x, 18)[1].at(planes)).sum(1)
                for x in (positions + change, positions - change)]
        assert_close((ends[0] - ends[1]) / 2e-6, slope[:, axis], 1e-7)


@pytest.mark.parametrize("wrong", [np.nan, np.inf, -np.inf, 1e300, -1e18])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_position_without_a_cell_is_told(library, wrong, axis):
    positions = np.ones((5000, 3))
    positions[[3777, 4999], axis] = wrong
    for splines in (reference_splines.Splines, lambda *given: Splines(library, *given)):
        with pytest.raises(MisplacedPoint) as raised:
            splines(3, positions, padded_planes(11))
        assert raised.value.number == 3777


def test_a_position_too_far_from_the_planes_is_told(library):
    padded = PaddedPlanes(20, 1.0, 8, 7)  # planes 8 ... 14: splines of points from 9 on, and below 13
    for z, placed in ((8.999, False), (9.0, True), (12.999, True), (13.0, False), (32.9, True), (-10.9, True)):
        for splines in (reference_splines.Splines, lambda *given: Splines(library, *given)):
            try:
                splines(3, np.array([[0.0, 0.0, z]]), padded)
            except MisplacedPoint:
                assert not placed
            else:
                assert placed


def test_columns_and_planes_of_another_size_are_refused(library):
    _, compiled = both(library, 3, np.zeros((4, 3)), 11)
    with pytest.raises(ValueError, match="4 points are needed"):
        compiled.spread(np.zeros((3, 2)), parts(11, 2))
    with pytest.raises(ValueError, match="18 planes"):
        compiled.at(parts(11)[1:])
