"""Functions of the linear operators of the two fluids, as factors of modes. These depend on |k| only, so planes kz < 0
share those of kz > 0."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from eddies.spectral.spectral_grid import SpectralGrid


class Decay:
    """Multiplies each mode by a real function of k^2."""

    def __init__(self, grid: SpectralGrid, function: Callable[[np.ndarray], np.ndarray]) -> None:
        #: (kz >= 0, ky, 1, kx)
        self.factors = by_wavenumber(grid, function)[:, :, None]


class AcousticBlock:
    """Acts on (u, v, w, s) as a scalar on the transverse velocity and as a real 2 x 2 matrix on (k.u, s):

        u' = transverse u + k (excess k.u + elastic sigma),   sigma' = identity sigma - coupling k.u,   sigma = -i s.

    All factors are real functions of k^2.
    """

    def __init__(self, grid: SpectralGrid, **factors: Callable[[np.ndarray], np.ndarray]) -> None:
        names = ("transverse", "excess", "elastic", "identity", "coupling")
        #: (kz >= 0, ky, 5, kx)
        self.factors = np.stack([by_wavenumber(grid, factors[name]) for name in names], axis=2)


def by_wavenumber(grid: SpectralGrid, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A real function of k^2, evaluated once for each integer |k|^2, for kz >= 0: (kz, ky, kx)."""
    unit = 2 * np.pi / grid.decomposition.length
    index_squared = grid.index_squared[: grid.cutoff + 1]
    distinct = np.unique(index_squared)
    table = np.zeros(3 * grid.cutoff**2 + 1)
    if len(distinct):
        table[distinct] = function(unit**2 * distinct)
    return table[index_squared].astype(grid.real)
