"""Functions of the linear operators of the two fluids, applied to states in cache-sized blocks of kz.

States are viewed as real numbers, real and imaginary parts alternating along kx, and factors are stored twice along kx
to match: products of real arrays run at full vector width, complex by real ones do not. Factors depend on |k| only, so
planes kz < 0 share those of kz > 0.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from eddies.spectral.spectral_grid import SpectralGrid

BLOCK_BYTES = 2**16  # of one component: a state, its result and the factors then fit a second-level cache


class Decay:
    """Multiplies each mode by a real function of k^2."""

    def __init__(self, grid: SpectralGrid, function: Callable[[np.ndarray], np.ndarray]) -> None:
        self.factor = by_wavenumber(grid, function)

    def add(self, state: np.ndarray, where: slice, out: np.ndarray) -> None:
        """Add the result for a block (c, kz, ky, 2 kx) of a state, whose factors stand at `where`."""
        out += self.factor[where] * state


class AcousticBlock:
    """Acts on (u, v, w, s) as a scalar on the transverse velocity and as a real 2 x 2 matrix on (k.u, s):

        u' = transverse u + k (excess k.u + elastic sigma),   sigma' = identity sigma - coupling k.u,   sigma = -i s.

    All factors are real functions of k^2.
    """

    def __init__(self, grid: SpectralGrid, **factors: Callable[[np.ndarray], np.ndarray]) -> None:
        self.transverse, self.excess, self.elastic, self.identity, self.coupling = (
            by_wavenumber(grid, factors[name]) for name in ("transverse", "excess", "elastic", "identity", "coupling"))

    def add(self, state: np.ndarray, where: slice, wavevector: Sequence[np.ndarray], out: np.ndarray,
            along: np.ndarray) -> None:
        """Add the result for a block (4, kz, ky, 2 kx); what is to be multiplied by k is added to `along`."""
        dotted, term = wavevector[0] * state[0], wavevector[1] * state[1]
        dotted += term
        dotted += np.multiply(wavevector[2], state[2], out=term)
        sigma = np.empty_like(term)
        sigma[..., ::2], sigma[..., 1::2] = state[3, ..., 1::2], -state[3, ..., ::2]
        out[:3] += self.transverse[where] * state[:3]
        along += np.multiply(self.excess[where], dotted, out=term)
        along += np.multiply(self.elastic[where], sigma, out=term)
        out[3] += np.multiply(self.identity[where], sigma, out=term)
        out[3] -= np.multiply(self.coupling[where], dotted, out=term)


def sum_of_decays(grid: SpectralGrid, terms: Sequence[tuple[Decay, np.ndarray]]) -> np.ndarray:
    """The sum of operators applied to states."""
    result = np.zeros_like(terms[0][1])
    for planes, where in _blocks(grid):
        out = result[:, planes].view(grid.real)
        for operator, state in terms:
            operator.add(state[:, planes].view(grid.real), where, out)
    return result


def sum_of_acoustic_blocks(grid: SpectralGrid, terms: Sequence[tuple[AcousticBlock, np.ndarray]]) -> np.ndarray:
    """The sum of operators applied to states."""
    result = np.zeros_like(terms[0][1])
    kx, ky, kz = grid.wavevector
    kx = np.repeat(kx, 2, axis=2)
    for planes, where in _blocks(grid):
        wavevector = kx, ky, kz[planes]
        out = result[:, planes].view(grid.real)
        along = np.zeros_like(out[0])
        for operator, state in terms:
            operator.add(state[:, planes].view(grid.real), where, wavevector, out, along)
        for component, k in zip(out, wavevector):
            component += k * along
        sigma = out[3].copy()
        out[3, ..., ::2], out[3, ..., 1::2] = -sigma[..., 1::2], sigma[..., ::2]
    return result


def by_wavenumber(grid: SpectralGrid, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A real function of k^2, evaluated once for each integer |k|^2, for kz >= 0: (kz, ky, 2 kx)."""
    unit = 2 * np.pi / grid.decomposition.length
    index_squared = grid.index_squared[: grid.cutoff + 1]
    distinct = np.unique(index_squared)
    table = np.zeros(3 * grid.cutoff**2 + 1)
    if len(distinct):
        table[distinct] = function(unit**2 * distinct)
    return np.repeat(table[index_squared].astype(grid.real), 2, axis=2)


def _blocks(grid: SpectralGrid) -> list[tuple[slice, slice]]:
    """Blocks of planes in storage order, kz = 0 ... K, -K ... -1, and where the factors of |kz| stand."""
    K = grid.cutoff
    size = max(1, BLOCK_BYTES // max(1, 2 * (K + 1) * grid.spectral_shape[1] * np.dtype(grid.real).itemsize))
    positive = [slice(start, min(start + size, K + 1)) for start in range(0, K + 1, size)]
    negative = [slice(start, min(start + size, grid.modes)) for start in range(K + 1, grid.modes, size)]
    return [(planes, planes) for planes in positive] + [
        (planes, slice(grid.modes - planes.start, grid.modes - planes.stop, -1)) for planes in negative]
