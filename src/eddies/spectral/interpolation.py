"""Fields at arbitrary points by B-splines whose coefficients are exact in Fourier space."""

from __future__ import annotations

import numpy as np

from eddies.parallel.halo import HaloError
from eddies.parallel.plane_halo import PlaneHalo
from eddies.spectral.spectral_grid import SpectralGrid

TOGETHER = 512  # points whose splines are held at once: a few MB
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
        #: by which each mode is multiplied to make it one of spline coefficients
        self.inverse = (1.0 / (transforms[0] * transforms[1] * transforms[2])).astype(grid.real)

    def coefficients(self, spectral: np.ndarray) -> np.ndarray:
        """Spline coefficients of fields (c, kz, ky, kx), with ghost planes: (ghosts + z_local, y, x, c)."""
        return self.with_ghosts(self.grid.backward(spectral * self.inverse))

    def with_ghosts(self, planes: np.ndarray) -> np.ndarray:
        """Planes (c, z_local, y, x) of coefficients as `at` wants them: (ghosts + z_local, y, x, c)."""
        return self._halo.forward(np.ascontiguousarray(np.moveaxis(planes, 0, -1)))

    def at(self, coefficients: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Values (n, c) at positions (n, 3), x and y anywhere, z within the slab and the margin (periodically)."""
        flat = coefficients.reshape(-1, coefficients.shape[-1])
        values = np.zeros((len(positions), flat.shape[1]))
        for first in range(0, len(positions), TOGETHER):
            block = slice(first, first + TOGETHER)
            rows, weights = self.stencil(positions[block], len(coefficients))
            values[block] = np.matmul(weights[:, None], flat[rows])[:, 0]
        return values

    def stencil(self, positions: np.ndarray, planes: int,
                derivative: int | None = None) -> tuple[np.ndarray, np.ndarray]:
        """The s = (degree + 1)^3 splines around points (n, 3): their rows (n, s) in the flattened padded planes, as
        many as there are, and their values (n, s) at the points; or the derivatives of these along one axis."""
        n, width, spacing = self.grid.cells, self.degree + 1, self.grid.decomposition.spacing
        scaled = np.asarray(positions) / spacing
        base = np.floor(scaled)
        along = [_spline_weights(self.degree, fraction) for fraction in (scaled - base).T]
        if derivative is not None:
            along[derivative] = _spline_slopes(self.degree, (scaled - base)[:, derivative]) / spacing
        first = base.astype(np.int64) - (self.degree - 1) // 2
        columns = [(first[:, axis, None] + np.arange(width)) % n for axis in (0, 1)]
        columns.append(self._rows(first[:, 2], planes)[:, None] + np.arange(width))
        rows = (columns[2][:, :, None, None] * n + columns[1][:, None, :, None]) * n + columns[0][:, None, None, :]
        weights = (along[2][:, :, None, None] * along[1][:, None, :, None]) * along[0][:, None, None, :]
        return rows.reshape(-1, width**3), weights.reshape(-1, width**3)

    def padded_planes(self) -> int:
        """Planes of coefficients, with those of the neighbours."""
        return self.grid.physical_shape[0] + self._halo.below + self._halo.above

    def without_ghosts(self, padded: np.ndarray) -> np.ndarray:
        """The transpose of `with_ghosts`: what stands on planes of the neighbours is added to theirs."""
        return np.ascontiguousarray(np.moveaxis(self._halo.adjoint(padded), -1, 0))

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


def _spline_weights(degree: int, fraction: np.ndarray) -> np.ndarray:
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


def _spline_slopes(degree: int, fraction: np.ndarray) -> np.ndarray:
    """Derivatives (n, degree + 1) of the weights with respect to `fraction`: differences of the next lower degree."""
    lower = _spline_weights(degree - 1, fraction)
    return np.pad(lower, ((0, 0), (1, 0))) - np.pad(lower, ((0, 0), (0, 1)))
