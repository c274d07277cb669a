"""Splines by numpy and scipy: a class with the methods of `eddies.kernels.splines.Splines`."""

from collections.abc import Sequence

import numpy as np
from scipy.interpolate import BSpline

from eddies.kernels.splines import MisplacedPoint, PaddedPlanes

FARTHEST = 1e15  # in cells; beyond, floating-point numbers do not resolve a cell


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
        rows, weights = self._stencils()
        return np.stack([(weights * plane.ravel()[rows]).sum(1) for plane in np.concatenate(parts, axis=1)], axis=1)

    def slope(self, parts: Sequence[np.ndarray], factors: np.ndarray) -> np.ndarray:
        """Gradient (n, 3) by the positions of sum_c factors_c f_c, at fixed factors (n, c)."""
        whole, gradient = np.concatenate(parts, axis=1), np.zeros((len(self._first), 3))
        for axis in range(3):
            rows, weights = self._stencils(axis)
            for plane, factor in zip(whole, factors.T):
                gradient[:, axis] += factor * (weights * plane.ravel()[rows]).sum(1)
        return gradient

    def spread(self, values: np.ndarray, parts: Sequence[np.ndarray]) -> None:
        """Add the transpose of `at`, applied to values (n, c), to planes."""
        rows, weights = self._stencils()
        added = np.zeros((values.shape[1], self._padded.planes * self._padded.cells**2))
        for component, column in zip(added, values.T):
            np.add.at(component, rows, weights * column[:, None])
        ends = np.cumsum([part.shape[1] for part in parts])
        shape = (-1, self._padded.planes, self._padded.cells, self._padded.cells)
        for part, more in zip(parts, np.split(added.reshape(shape), ends[:-1], axis=1)):
            part += more

    def _stencils(self, derivative: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """Rows (n, s) of the splines in flattened planes, and their values or derivatives (n, s) along one axis."""
        cells, width = self._padded.cells, self.degree + 1
        element, places = BSpline.basis_element(np.arange(width + 1)), np.arange(self.degree, -1, -1)
        along = [element(fraction[:, None] + places) for fraction in self._fraction.T]
        if derivative is not None:
            along[derivative] = element(self._fraction[:, derivative, None] + places, 1) / self._padded.spacing
        x, y, z = ((first[:, None] + np.arange(width)) for first in self._first.T)
        rows = (z[:, :, None, None] * cells + y[:, None, :, None] % cells) * cells + x[:, None, None, :] % cells
        weights = along[2][:, :, None, None] * along[1][:, None, :, None] * along[0][:, None, None, :]
        return rows.reshape(len(rows), width**3), weights.reshape(len(rows), width**3)
