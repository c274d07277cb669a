"""Operators on the modes of fields, for numpy arrays and torch tensors; autograd differentiates them on tensors.

Modes are (..., kz, ky, kx). The components of vectors have the order x, y, z, and those of symmetric matrices the
order xx, yy, zz, xy, xz, yz.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

#: A numpy array or a torch tensor.
Modes = Any


class ModeOperators:
    """Derivatives and projections of fields that are given by their modes.

    Parameters
    ----------
    wavevector : kx, ky, kz, each of a shape that broadcasts to (kz, ky, kx).
    wavenumber_squared : k^2 (kz, ky, kx).
    stack : numpy.stack or torch.stack.
    """

    def __init__(self, wavevector: Sequence[Modes], wavenumber_squared: Modes,
                 stack: Callable[[Sequence[Modes]], Modes]) -> None:
        self.wavevector, self.wavenumber_squared, self._stack = tuple(wavevector), wavenumber_squared, stack
        mean = wavenumber_squared == 0
        #: 1/k^2, but 0 for k = 0
        self.inverse_squared = (1 / (wavenumber_squared + mean)) * ~mean

    def along_wavevector(self, vector: Modes) -> Modes:
        """Return k.u (kz, ky, kx) of a vector (3, kz, ky, kx)."""
        kx, ky, kz = self.wavevector
        return kx * vector[0] + ky * vector[1] + kz * vector[2]

    def gradient(self, scalar: Modes) -> Modes:
        """Return i k f (3, kz, ky, kx) of a scalar (kz, ky, kx)."""
        return self._stack([1j * k * scalar for k in self.wavevector])

    def divergence(self, vector: Modes) -> Modes:
        """Return i k.u (kz, ky, kx) of a vector (3, kz, ky, kx)."""
        return 1j * self.along_wavevector(vector)

    def solenoidal(self, vector: Modes) -> Modes:
        """Return u - k (k.u) / k^2, the projection of a vector (3, kz, ky, kx) on solenoidal fields."""
        along = self.along_wavevector(vector) * self.inverse_squared
        return self._stack([component - k * along for k, component in zip(self.wavevector, vector)])

    def stress_divergence(self, stress: Modes) -> Modes:
        """Return d_j tau_ij (3, kz, ky, kx) of a symmetric matrix tau (6, kz, ky, kx)."""
        xx, yy, zz, xy, xz, yz = stress
        return self._stack([self.divergence(row) for row in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))])

    def pressure_of(self, stress: Modes) -> Modes:
        """Return p (kz, ky, kx), the solution of  laplacian p = -d_i d_j tau_ij  with mean zero.

        tau (6, kz, ky, kx) is a symmetric matrix. div tau + grad p is solenoidal. With tau = u u, p is the kinematic
        pressure of an incompressible flow u.
        """
        kx, ky, kz = self.wavevector
        xx, yy, zz, xy, xz, yz = stress
        along = kx * kx * xx + ky * ky * yy + kz * kz * zz + 2 * (kx * ky * xy + kx * kz * xz + ky * kz * yz)
        return -along * self.inverse_squared


def rising(shell: Modes, highest: float, values: Modes) -> Modes:
    """Return a piecewise linear function of the wavenumbers `shell`, which serves as a learned damping rate.

    The function is 0 at k = 0 and has the `values` (n,) at k = `highest` i / n, i = 1 ... n. Beyond `highest` it is
    constant.
    """
    place, result, before = shell * (len(values) / highest), 0.0, 0.0
    for number, value in enumerate(values):
        result = result + (value - before) * (place - number).clip(0, 1)
        before = value
    return result


def gaussian_transfer(wavenumber_squared: np.ndarray | float, width: float) -> np.ndarray:
    """Return exp(-k^2 d^2 / 24), the Fourier transform of the Gaussian filter of width d.

    The filter has the second moment of a box filter of the same width (Pope 2000, Table 13.2).
    """
    return np.exp(-np.asarray(wavenumber_squared) * width**2 / 24)
