"""Fields at arbitrary points by B-splines whose coefficients are exact in Fourier space."""

from __future__ import annotations

import numpy as np

from eddies.flow.spectral_grid import SpectralGrid
from eddies.parallel.halo import HaloError
from eddies.parallel.plane_halo import PlaneHalo

ORDERS = {"cubic": 3, "quintic": 5}


class SplineInterpolation:
    """Tensor-product B-splines through the grid values of band-limited fields.

    The spline coefficients follow from dividing each Fourier mode by the transform of the B-spline, so they are those
    of the interpolating spline exactly (Hinsberg et al. 2012). The error of a mode k is of order (k dx)^(degree + 1).

    Parameters
    ----------
    grid : where the field is sampled.
    kind : "cubic" or "quintic".
    margin : planes by which a point may lie outside this rank's slab, as a predicted position does.
    """

    def __init__(self, grid: SpectralGrid, kind: str, margin: int = 1) -> None:
        self.grid, self.degree = grid, ORDERS[kind]
        reach = (self.degree - 1) // 2
        self._halo = PlaneHalo(grid.decomposition, reach + margin, reach + 1 + margin)
        angle = 2 * np.pi / grid.cells
        transforms = [_spline_transform(self.degree, angle * axis) for axis in grid.index]
        self._inverse = (1.0 / (transforms[0] * transforms[1] * transforms[2])).astype(grid.real)

    def coefficients(self, spectral: np.ndarray) -> np.ndarray:
        """Spline coefficients of fields (c, kz, ky, kx), with ghost planes: (ghosts + z_local, y, x, c)."""
        planes = self.grid.backward(spectral * self._inverse)
        return self._halo.forward(np.ascontiguousarray(np.moveaxis(planes, 0, -1)))

    def at(self, coefficients: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Values (n, c) at positions (n, 3), x and y anywhere, z within the slab and the margin (periodically)."""
        n, width, components = self.grid.cells, self.degree + 1, coefficients.shape[-1]
        slab = self.grid.decomposition
        scaled = np.asarray(positions) / slab.spacing
        base = np.floor(scaled)
        weights = _spline_weights(self.degree, scaled - base)
        first = base.astype(np.int64) - (self.degree - 1) // 2
        columns = [(first[:, axis, None] + np.arange(width)) % n for axis in (0, 1)]
        rows = self._rows(first[:, 2], len(coefficients))
        flat = coefficients.reshape(-1, components)
        values = np.zeros((len(scaled), components))
        for k in range(width):
            for j in range(width):
                line = ((rows + k) * n + columns[1][:, j]) * n
                weight = weights[2][:, k] * weights[1][:, j]
                for i in range(width):
                    values += (weight * weights[0][:, i])[:, None] * flat[line + columns[0][:, i]]
        return values

    def _rows(self, first: np.ndarray, planes: int) -> np.ndarray:
        """Index in the padded planes of the first of the planes that each point needs."""
        slab, n = self.grid.decomposition, self.grid.cells
        lowest = slab.start - self._halo.below
        rows = (first - lowest) % n
        if len(rows) and rows.max() + self.degree + 1 > planes:
            raise HaloError("a particle moves farther out of its slab in one step than the ghost planes reach: "
                            "lower [time] step, courant or max_step")
        return rows


def _spline_transform(degree: int, angle: np.ndarray) -> np.ndarray:
    """Discrete Fourier transform of the integer samples of the cubic or quintic B-spline."""
    if degree == 3:
        return (2 + np.cos(angle)) / 3
    return (33 + 26 * np.cos(angle) + np.cos(2 * angle)) / 60


def _spline_weights(degree: int, fraction: np.ndarray) -> list[np.ndarray]:
    """For each of three axes the degree + 1 B-spline weights (n, degree + 1) of points at `fraction` (n, 3) of a cell.

    Built up from the constant spline by the recursion of de Boor on uniform knots.
    """
    weights = []
    for t in fraction.T:
        w = np.ones((len(t), 1))
        for order in range(1, degree + 1):
            # The distance of the point from the left end of each of the `order` overlapping splines.
            left = t[:, None] + np.arange(order - 1, -1, -1)
            next_w = np.zeros((len(t), order + 1))
            next_w[:, :-1] += w * (order - left)
            next_w[:, 1:] += w * left
            w = next_w / order
        weights.append(w)
    return weights
