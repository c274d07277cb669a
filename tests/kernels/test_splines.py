"""Compiled splines against scipy, their transpose and their slopes."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates

from eddies.kernels.splines import MisplacedPoint, Splines

SPACING, BELOW, ABOVE = 0.3, 3, 4
# Degree, components, cells: fewer cells than splines are wide, one chunk of lines, and many of them.
SIZES = [(3, 3, 4), (5, 7, 7), (3, 1, 11), (5, 3, 18), (3, 3, 41)]
CLOUDS = {
    "even": lambda random, n: random.uniform(-2 * n, 3 * n, (1500, 3)),
    "coincident": lambda random, n: np.full((500, 3), 0.37 * n),
    "one cell": lambda random, n: n - 1 + random.uniform(0, 1, (500, 3)),
    "on grid points": lambda random, n: random.integers(-n, 2 * n, (200, 3)).astype(float),
    "none": lambda random, n: np.zeros((0, 3)),
}


def whole(cells):
    """The grid and the planes of a slab that is the whole box, as `Splines` takes them."""
    return cells, SPACING, range(-BELOW, cells + ABOVE)


def parts(cells, components=3, kind=np.float64):
    """Random planes below, own ones, planes above."""
    random = np.random.default_rng(1)
    return [random.standard_normal((components, planes, cells, cells)).astype(kind)
            for planes in (BELOW, cells, ABOVE)]


def by_scipy(degree, positions, planes, cells):
    """Values (n, c) of the splines at positions. The first of their planes is one of the first `cells` planes."""
    (x, y, z), before = positions.T / SPACING, (degree - 1) // 2
    first = (np.floor(z) - before + BELOW) % cells
    places = np.stack([first + before + z - np.floor(z), y % cells, x % cells])
    return np.stack([map_coordinates(component, places, order=degree, mode="grid-wrap", prefilter=False)
                     for component in np.concatenate(planes, axis=1).astype(float)], axis=1)


@pytest.mark.parametrize("kind, degree, components, cells", [
    *(("even", *size) for size in SIZES), ("coincident", *SIZES[1]), ("one cell", *SIZES[0]),
    ("on grid points", *SIZES[1]), ("none", *SIZES[0])])
def test_values_their_transpose_and_slopes(library, close, kind, degree, components, cells):
    """The spread values and the planes have the same product as the values at the points. Slopes are differences."""
    random = np.random.default_rng(2)
    positions = SPACING * CLOUDS[kind](random, cells)
    splines = Splines(degree, positions, *whole(cells))
    for precision, error in ((np.float64, 1e-12), (np.float32, 1e-6)):
        planes, factors = parts(cells, components, precision), random.standard_normal((len(positions), components))
        values = splines.at(planes)
        close(values, by_scipy(degree, positions, planes, cells), error, least=0.1)
        spread = [0 * part for part in planes]
        splines.spread(factors, spread)
        products = [np.sum(a.astype(float) * b) for a, b in (*zip(spread, planes), (factors, values))]
        assert sum(products[:3]) == pytest.approx(products[3], rel=10 * error, abs=error * np.abs(factors).sum())
        slopes = splines.slope(planes, factors)
        for axis, change in enumerate(1e-5 * np.eye(3)):
            ends = [np.sum(factors * by_scipy(degree, x, planes, cells), axis=1)
                    for x in (positions + change, positions - change)]
            if kind != "on grid points":  # third derivatives of cubic splines jump there
                close(slopes[:, axis], (ends[0] - ends[1]) / 2e-5, 1e-5, least=0.1)


def test_arrays_of_any_layout(library):
    """The copy of positions that are not contiguous must live until the call has ended."""
    positions = np.random.default_rng(2).uniform(0, 5, (1000, 3)).astype(np.float32)
    expected = Splines(3, positions.astype(float), *whole(18)).at(parts(18))
    turned = [np.asfortranarray(part) for part in parts(18)]
    for other in (positions, np.asfortranarray(positions, float)):
        for _ in range(10):
            splines = Splines(3, other, *whole(18))
            assert np.array_equal(splines.at(parts(18)), expected)
    assert np.array_equal(splines.at(turned), expected)


@pytest.mark.parametrize("wrong", [np.nan, -np.inf, 1e18])
def test_the_first_position_without_a_cell_is_named(library, wrong):
    positions = np.ones((5000, 3))
    positions[[3777, 4999], [0, 2]] = wrong
    with pytest.raises(MisplacedPoint) as raised:
        Splines(3, positions, *whole(11))
    assert raised.value.number == 3777


def test_a_position_too_far_from_the_planes_is_refused(library):
    planes = range(8, 15)  # splines of points from 9 on, and below 13
    for z in (9.0, 12.999, 32.9, -10.9):
        Splines(3, np.array([[0.0, 0.0, z]]), 20, 1.0, planes)
    for z in (8.999, 13.0):
        with pytest.raises(MisplacedPoint):
            Splines(3, np.array([[0.0, 0.0, z]]), 20, 1.0, planes)
