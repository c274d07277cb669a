"""X"""

from __future__ import annotations

import numpy as np

from eddies.spectral.spectral_grid import SpectralGrid


def pressure(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """Kinematic pressure of an incompressible flow: the solution of  laplacian p = -d_i d_j (u_i u_j), mean zero.

    Takes and returns Fourier coefficients, (3, kz, ky, kx) -> (kz, ky, kx). Products are free of aliasing if the
    grid's cutoff is that of the 2/3 rule.
    """
    u, v, w = grid.backward(velocity)
    xx, yy, zz, xy, xz, yz = grid.forward(np.stack([u * u, v * v, w * w, u * v, u * w, v * w]))
    kx, ky, kz = grid.wavevector
    stress = kx * kx * xx + ky * ky * yy + kz * kz * zz + 2 * (kx * ky * xy + kx * kz * xz + ky * kz * yz)
    return -stress * grid.inverse_squared
