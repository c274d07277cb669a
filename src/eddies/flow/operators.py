"""Derivatives and projections in Fourier space. Arrays as in SpectralGrid: vectors (3, kz, ky, kx), order x, y, z."""

from __future__ import annotations

import numpy as np

from eddies.spectral.spectral_grid import SpectralGrid


def gradient(grid: SpectralGrid, scalar: np.ndarray) -> np.ndarray:
    """i k f: the three derivatives of one component (kz, ky, kx)."""
    return np.stack([1j * k * scalar for k in grid.wavevector]).astype(grid.complex, copy=False)


def divergence(grid: SpectralGrid, vector: np.ndarray) -> np.ndarray:
    """i k.u of a vector field."""
    return 1j * dot_wavevector(grid, vector)


def dot_wavevector(grid: SpectralGrid, vector: np.ndarray) -> np.ndarray:
    """k.u of a vector field."""
    kx, ky, kz = grid.wavevector
    return kx * vector[0] + ky * vector[1] + kz * vector[2]


def inverse_wavenumber_squared(grid: SpectralGrid) -> np.ndarray:
    """1 / k^2, and 0 for the mean mode."""
    return np.divide(1.0, grid.wavenumber_squared, out=np.zeros_like(grid.wavenumber_squared),
                     where=grid.index_squared > 0)


def project(grid: SpectralGrid, vector: np.ndarray) -> np.ndarray:
    """Solenoidal part u - k (k.u) / k^2 of a vector field."""
    longitudinal = dot_wavevector(grid, vector) * inverse_wavenumber_squared(grid)
    return np.stack([component - k * longitudinal for k, component in zip(grid.wavevector, vector)])


def pressure(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """Kinematic pressure of an incompressible flow: the solution of  laplacian p = -d_i d_j (u_i u_j), mean zero.

    Takes and returns Fourier coefficients, (3, kz, ky, kx) -> (kz, ky, kx). Products are free of aliasing if the
    grid's cutoff is that of the 2/3 rule.
    """
    u, v, w = grid.backward(velocity)
    xx, yy, zz, xy, xz, yz = grid.forward(np.stack([u * u, v * v, w * w, u * v, u * w, v * w]))
    kx, ky, kz = grid.wavevector
    stress = kx * kx * xx + ky * ky * yy + kz * kz * zz + 2 * (kx * ky * xy + kx * kz * xz + ky * kz * yz)
    return -stress * inverse_wavenumber_squared(grid)
