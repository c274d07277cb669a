"""What `eddies.kernels.splines` computes, by numpy: a class with the same methods."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from eddies.kernels.splines import MisplacedPoint, PaddedPlanes

TOGETHER = 512    # points whose splines are held at once: a few MB
FARTHEST = 1e15   # in cells; beyond, numbers do not tell one from the next


class Splines:
    """The s = (degree + 1)^3 tensor-product B-splines around each of some points (n, 3), of degree 3 or 5."""

    def __init__(self, degree: int, positions: np.ndarray, padded: PaddedPlanes) -> None:
        self.degree, self._padded = degree, padded
        scaled = np.asarray(positions, np.float64) / padded.spacing
        cell = np.floor(scaled)
        placed = (np.abs(cell) < FARTHEST).all(1)
        scaled[~placed], cell[~placed] = 0, 0
        self._fraction, self._first = scaled - cell, cell.astype(np.int64) - (degree - 1) // 2
        self._first[:, 2] -= padded.lowest
        self._first %= padded.cells
        placed &= self._first[:, 2] + degree < padded.planes
        if not placed.all():
            raise MisplacedPoint(int(np.argmin(placed)))

    def at(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Values (n, c) of planes."""
        return self._values(parts, None)

    def slope(self, parts: Sequence[np.ndarray], factors: np.ndarray) -> np.ndarray:
        """Gradient (n, 3) with respect to the positions of sum_c factors_c f_c, the factors (n, c) held fixed."""
        return np.stack([(factors * self._values(parts, axis)).sum(1) for axis in range(3)], axis=1)

    def spread(self, values: np.ndarray, parts: Sequence[np.ndarray]) -> None:
        """Transpose of `at`: values (n, c) added to planes."""
        cells, planes = self._padded.cells, self._padded.planes
        added = np.zeros((values.shape[1], planes * cells**2))
        for block, rows, weights in self._stencils():
            for component, column in zip(added, values[block].T):
                np.add.at(component, rows, weights * column[:, None])
        ends = np.cumsum([part.shape[1] for part in parts])
        for part, more in zip(parts, np.split(added.reshape(-1, planes, cells, cells), ends[:-1], axis=1)):
            part += more

    def _values(self, parts: Sequence[np.ndarray], derivative: int | None) -> np.ndarray:
        whole = np.concatenate(parts, axis=1)
        flat = np.ascontiguousarray(whole.reshape(len(whole), -1).T)
        values = np.empty((len(self._first), len(whole)))
        for block, rows, weights in self._stencils(derivative):
            values[block] = np.matmul(weights[:, None], flat[rows])[:, 0]
        return values

    def _stencils(self, derivative: int | None = None) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Block by block of points, the splines around them: their rows (n, s) in the flattened planes, and their
        values (n, s) at the points, or the derivatives of these along one axis."""
        cells, width = self._padded.cells, self.degree + 1
        for start in range(0, len(self._first), TOGETHER):
            block = slice(start, start + TOGETHER)
            along = [spline_weights(self.degree, fraction) for fraction in self._fraction[block].T]
            if derivative is not None:
                slopes = spline_slopes(self.degree, self._fraction[block, derivative])
                along[derivative] = slopes / self._padded.spacing
            x, y, z = ((first[:, None] + np.arange(width)) for first in self._first[block].T)
            rows = (z[:, :, None, None] * cells + y[:, None, :, None] % cells) * cells + x[:, None, None, :] % cells
            weights = along[2][:, :, None, None] * along[1][:, None, :, None] * along[0][:, None, None, :]
            yield block, rows.reshape(-1, width**3), weights.reshape(-1, width**3)


def spline_weights(degree: int, fraction: np.ndarray) -> np.ndarray:
    """The degree + 1 B-spline weights (n, degree + 1) of points at `fraction` (n,) of a cell.

    Built up from the constant spline by the recursion of de Boor on uniform knots.
    """
    weights = np.ones((len(fraction), 1))
    for order in range(1, degree + 1):
        # The distance of the point from the left end of each of the `order` overlapping splines.
        left = fraction[:, None] + np.arange(order - 1, -1, -1)
        following = np.zeros((len(fraction), order + 1))
        following[:, :-1] += weights * (order - left)
        following[:, 1:] += weights * left
        weights = following / order
    return weights


def spline_slopes(degree: int, fraction: np.ndarray) -> np.ndarray:
    """Derivatives (n, degree + 1) of the weights with respect to `fraction`: differences of the next lower degree."""
    lower = spline_weights(degree - 1, fraction)
    return np.pad(lower, ((0, 0), (1, 0))) - np.pad(lower, ((0, 0), (0, 1)))
