"""A flow whose velocity is a linear function of the place: a mean flow and a mean shear."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class LinearFlow:
    """The steady incompressible velocity W = U + G (x - x0).

    Places are given by arrays x, y, z, which broadcast to the shape of the result.

    Parameters
    ----------
    center, velocity : x0 and U, (3,). gradient : G_ij = dW_i/dx_j, (3, 3), with the trace 0.
    """

    center: np.ndarray
    velocity: np.ndarray
    gradient: np.ndarray

    @classmethod
    def fitted(cls, position: np.ndarray, velocity: np.ndarray, center: np.ndarray) -> LinearFlow:
        """Return the flow that fits velocities (n, 3) at positions (n, 3) best by least squares, with this centre.

        The trace of G is 0 by a Lagrange multiplier. What the positions do not determine is 0.
        """
        terms = np.column_stack([np.ones(len(position)), position - center])
        inverse = np.linalg.pinv(terms.T @ terms, hermitian=True)
        found, spread = inverse @ (terms.T @ velocity), np.trace(inverse[1:, 1:])
        if spread > 0:
            found -= np.trace(found[1:]) / spread * inverse[:, 1:]
        return cls(center, found[0], found[1:].T)

    def at(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the velocity (3, ...)."""
        return self._linear(self.velocity, self.gradient, x, y, z)

    def acceleration(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return -grad P (3, ...), the acceleration that the pressure gives; see `pressure`."""
        return self._linear(*self._pushed, x, y, z)

    def pressure(self, x: np.ndarray, y: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Return the kinematic pressure P (1, ...) of this flow, 0 at the centre.

        The acceleration of the flow is G W = G U + G G r. A pressure gives the symmetric part of G G:
        P = -r.G U - r.(G G + (G G)^T) r / 4.
        """
        start, slope = self._pushed
        half = self._linear(start, slope / 2, x, y, z)
        return -sum((place - middle) * each for place, middle, each in zip((x, y, z), self.center, half))[None]

    @property
    def _pushed(self) -> tuple[np.ndarray, np.ndarray]:
        square = self.gradient @ self.gradient
        return self.gradient @ self.velocity, (square + square.T) / 2

    def _linear(self, start: np.ndarray, slope: np.ndarray, *place: np.ndarray) -> np.ndarray:
        distance = [each - middle for each, middle in zip(place, self.center)]
        components = [constant + sum(factor * along for factor, along in zip(row, distance))
                      for constant, row in zip(start, slope)]
        return np.stack(np.broadcast_arrays(*components))
