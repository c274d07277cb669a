"""What the scales that a coarse grid does not resolve do to the others."""

from __future__ import annotations

import numpy as np

from eddies.flow.operators import dot_wavevector
from eddies.spectral.spectral_grid import SpectralGrid


class Smagorinsky:
    """Eddy viscosity of large-eddy simulation (Smagorinsky 1963), the force  div(2 nu_t S),

        nu_t = (C_s Delta)^2 |S|,   |S| = (2 S:S)^(1/2),   S = (grad u + grad u^T) / 2.

    It takes the energy <2 nu_t S:S> from the resolved velocity and leaves the momentum alone. The stress is formed at
    the grid points; it is not a polynomial, so the 2/3 rule does not free it of aliasing.

    Parameters
    ----------
    grid : of the velocity.
    constant : C_s.
    width : Delta, the filter width.
    """

    # Rows of a symmetric matrix xx, yy, zz, xy, xz, yz that make up the row of each component.
    ROWS = ((0, 3, 4), (3, 1, 5), (4, 5, 2))

    def __init__(self, grid: SpectralGrid, constant: float, width: float) -> None:
        self.grid, self.mixing_length = grid, constant * width

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's tendency in place; both (3, kz, ky, kx), Fourier space."""
        stress = self.stress(velocity)
        for component, row in zip(tendency, self.ROWS):
            component += 1j * dot_wavevector(self.grid, stress[list(row)])

    def stress(self, velocity: np.ndarray) -> np.ndarray:
        """Modes of 2 nu_t S, (6, kz, ky, kx) in the order xx, yy, zz, xy, xz, yz."""
        return self.grid.multiply(velocity, self._stress, 6, fields=9, expand=self._gradients, z_derivatives=3)

    def _gradients(self, modes: np.ndarray) -> list[np.ndarray]:
        """Derivatives of the velocity along x, along y and along z."""
        return [(self.grid.d_dx, modes[:3]), (self.grid.d_dy, modes[:3]), modes[3:]]

    def _stress(self, gradients: np.ndarray, out: np.ndarray) -> None:
        d_dx, d_dy, d_dz = gradients.reshape(3, 3, *gradients.shape[1:])
        out[0], out[1], out[2] = d_dx[0], d_dy[1], d_dz[2]
        out[3], out[4], out[5] = (d_dx[1] + d_dy[0]) / 2, (d_dx[2] + d_dz[0]) / 2, (d_dy[2] + d_dz[1]) / 2
        squared = (out[:3] ** 2).sum(axis=0) + 2 * (out[3:] ** 2).sum(axis=0)
        out *= 2 * self.mixing_length**2 * np.sqrt(2 * squared)
