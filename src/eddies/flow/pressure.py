"""The pressure that keeps a velocity field, known on a grid, solenoidal; at the points of particles."""

from __future__ import annotations

import numpy as np

from eddies.flow.interpolation import SplineInterpolation
from eddies.flow.operators import pressure
from eddies.flow.spectral_grid import SpectralGrid
from eddies.parallel.slab import SlabDecomposition


class PressureSolver:
    """Poisson's equation  laplacian p = -d_i d_j (u_i u_j)  for the modes |k| <= `resolved` of a grid.

    Products of modes above a third of the number of cells alias; with three quarters of the Nyquist wavenumber kept,
    as for fields known from particles, that is far below the error of the highest modes themselves.

    `points` (m, 3) are this rank's grid points, z slowest. Positions given to the other methods must lie in this
    rank's slab, or at most `reach` outside, which is `margin` grid planes.
    """

    def __init__(self, decomposition: SlabDecomposition, resolved: int, margin: int = 1) -> None:
        self.decomposition = decomposition
        self.grid = SpectralGrid(decomposition, cutoff=resolved)
        self._kept = self.grid.index_squared <= resolved**2
        self.reach = margin * decomposition.spacing
        self._spline = SplineInterpolation(self.grid, "cubic", margin)
        x, y, z = np.broadcast_arrays(*self.grid.coordinates())
        self.points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)

    def modes(self, values: np.ndarray) -> np.ndarray:
        """Resolved Fourier modes (3, kz, ky, kx) of a vector field given at `points`, (m, 3)."""
        return self._kept * self.grid.forward(values.T.reshape(3, *self.grid.physical_shape))

    def velocity_at(self, modes: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """The field of the modes at positions (n, 3): (n, 3)."""
        return self._spline.at(self._spline.coefficients(modes), positions)

    def pressure_at(self, modes: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """The pressure of the velocity of the modes at positions (n, 3): (n,)."""
        coefficients = self._spline.coefficients(pressure(self.grid, modes)[None])
        return self._spline.at(coefficients, positions)[:, 0]
