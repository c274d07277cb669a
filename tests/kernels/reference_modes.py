"""What `eddies.kernels.modes` computes, by numpy: a class with the same methods."""

from __future__ import annotations

import numpy as np


class ModePasses:
    """What an iteration does to modes (3, kz, ky, kx)."""

    def __init__(self, wavevector: tuple[np.ndarray, ...], multiplicity: np.ndarray, inverse_squared: np.ndarray,
                 scale: np.ndarray, penalty: np.ndarray) -> None:
        self.wavevector, self.multiplicity, self.inverse_squared = wavevector, multiplicity, inverse_squared
        self.scale, self.penalty = scale, penalty

    def image(self, given: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, float]:
        """P (scale given) + penalty modes, and the inner product of that with `modes`, of this rank."""
        scaled = self.scale * given
        along = sum(k * component for k, component in zip(self.wavevector, scaled)) * self.inverse_squared
        image = scaled - np.stack([k * along for k in self.wavevector]) + self.penalty * modes
        return image, self._product(image, modes)

    def descend(self, length: float, inverse: np.ndarray, direction: np.ndarray, image: np.ndarray, found: np.ndarray,
                residual: np.ndarray) -> float:
        """found += length direction, residual -= length image, and the inner product of the residual with `inverse`
        times it, of this rank."""
        found += length * direction
        residual -= length * image
        return self._product(residual, inverse * residual)

    def turn(self, share: float, inverse: np.ndarray, residual: np.ndarray, direction: np.ndarray) -> None:
        """direction = inverse residual + share direction."""
        direction *= share
        direction += inverse * residual

    def _product(self, first: np.ndarray, second: np.ndarray) -> float:
        products = self.multiplicity * (first.real * second.real + first.imag * second.imag)
        return float(np.sum(products, dtype=np.float64))
