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


def curl(grid: SpectralGrid, vector: np.ndarray) -> np.ndarray:
    """i k x u of a vector field."""
    kx, ky, kz = grid.wavevector
    u, v, w = vector
    return np.stack([1j * (ky * w - kz * v), 1j * (kz * u - kx * w), 1j * (kx * v - ky * u)])


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


def pressure_adjoint(grid: SpectralGrid, velocity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Transpose of the derivative of `pressure` with respect to the velocity, applied to weights of the pressure.

    All are Fourier coefficients: velocity (3, kz, ky, kx), weights and the result's components (kz, ky, kx). With
    inner products over physical space, <weights, dp> = <result, du> for every small change du of the velocity:
    result_i = 2 sum_j u_j (-k_i k_j / k^2) weights.
    """
    planes = grid.backward(velocity)
    scaled = -weights * inverse_wavenumber_squared(grid)
    kx, ky, kz = grid.wavevector
    xx, yy, zz, xy, xz, yz = grid.backward(
        np.stack([kx * kx * scaled, ky * ky * scaled, kz * kz * scaled, kx * ky * scaled, kx * kz * scaled,
                  ky * kz * scaled]))
    u, v, w = planes
    return grid.forward(2 * np.stack([xx * u + xy * v + xz * w, xy * u + yy * v + yz * w, xz * u + yz * v + zz * w]))


def velocity_gradients(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """d_j u_i in physical space, (3, 3, z_local, y, x), of modes (3, kz, ky, kx)."""
    derivatives = np.concatenate([gradient(grid, component) for component in velocity])
    return grid.backward(derivatives).reshape(3, 3, *grid.physical_shape)


def gradient_stress_divergence(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """d_j (d_k u_i d_k u_j): the divergence of the stress of the gradient model, of modes (3, kz, ky, kx), as modes.

    Times d^2 / 12 it is the leading term of what a filter of width d hides (Leonard 1975; Clark et al. 1979).
    """
    slopes = velocity_gradients(grid, velocity)
    return _divergence_of_products(grid, slopes, slopes)


def gradient_stress_divergence_adjoint(grid: SpectralGrid, velocity: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Transpose of the derivative of `gradient_stress_divergence` with respect to the velocity, applied to weights.

    All are modes (3, kz, ky, kx). result_i = d_k ((d_j w_i + d_i w_j) d_k u_j).
    """
    strain = velocity_gradients(grid, weights)
    strain = strain + strain.swapaxes(0, 1)
    slopes = velocity_gradients(grid, velocity)
    fluxes = grid.forward(np.einsum("ij...,jk...->ik...", strain, slopes).reshape(9, *grid.physical_shape))
    return np.stack([divergence(grid, flux) for flux in fluxes.reshape(3, 3, *grid.spectral_shape)])


def _divergence_of_products(grid: SpectralGrid, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Modes of d_j (a_ik b_jk) where a_ik b_jk is symmetric in i and j."""
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    xx, yy, zz, xy, xz, yz = grid.forward(np.stack([np.sum(first[i] * second[j], axis=0) for i, j in pairs]))
    return np.stack([divergence(grid, row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])
