"""What `eddies.kernels.flow` computes, by numpy: a class with the same methods."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from eddies.spectral.spectral_grid import SpectralGrid

Terms = Sequence[tuple[np.ndarray, np.ndarray]]


class Formulas:
    """What is done to fields (c, ...) at grid points and to modes (c, kz, ky, kx)."""

    def __init__(self, grid: SpectralGrid) -> None:
        self.grid = grid

    def advection(self, fields: np.ndarray, viscosity: float, out: np.ndarray) -> None:
        """-u.grad u + 2 nu (S - 1/3 div u).grad s  and  -u.grad s  (4, ...) of u, and the derivatives of (u, v, w, s)
        along x, along y and along z (15, ...)."""
        u, gradients = fields[:3], fields[3:].reshape(3, 4, *fields.shape[1:])
        out[...] = -sum(u[j] * gradients[j] for j in range(3))
        if viscosity > 0:
            A, H = gradients[:, :3], viscosity * gradients[:, 3]
            divergence = A[0, 0] + A[1, 1] + A[2, 2]
            for i in range(3):
                out[i] += sum((A[i, j] + A[j, i]) * H[j] for j in range(3)) - 2 / 3 * divergence * H[i]

    def cross(self, fields: np.ndarray, out: np.ndarray) -> None:
        """u x omega (3, ...) of both, (6, ...)."""
        u, omega = fields[:3], fields[3:]
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            out[i] = u[j] * omega[k] - u[k] * omega[j]

    def project(self, vector: np.ndarray) -> np.ndarray:
        """u - k (k.u) / k^2."""
        return self.grid.solenoidal(vector)

    def sum_of_decays(self, terms: Terms) -> np.ndarray:
        """The sum of factors, n = 1, times states."""
        return sum(_at_all_kz(factors) * state for factors, state in terms)

    def sum_of_acoustic_blocks(self, terms: Terms) -> np.ndarray:
        """The sum of states (4, ...), to each of which the acoustic block of its five factors is applied."""
        result = np.zeros_like(terms[0][1])
        for factors, state in terms:
            transverse, excess, elastic, identity, coupling = _at_all_kz(factors)
            dotted, sigma = self.grid.along_wavevector(state[:3]), -1j * state[3]
            along = excess * dotted + elastic * sigma
            for component, k, u in zip(result, self.grid.wavevector, state):
                component += transverse * u + k * along
            result[3] += 1j * (identity * sigma - coupling * dotted)
        return result


def _at_all_kz(factors: np.ndarray) -> np.ndarray:
    """Factors (kz >= 0, ky, n, kx) at kz = 0 ... K, -K ... -1: (n, kz, ky, kx)."""
    return np.moveaxis(np.concatenate([factors, factors[:0:-1]]), 2, 0)
