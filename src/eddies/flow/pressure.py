"""What a velocity field known on a grid does to the particles in it: its pressure and its forces, with adjoints."""

from __future__ import annotations

import numpy as np

from eddies.spectral.interpolation import SplineInterpolation
from eddies.flow.operators import (
    divergence, gradient, gradient_stress_divergence, gradient_stress_divergence_adjoint, pressure, pressure_adjoint,
    project,
)
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition

# Wavenumber shells in a band of the energy.
BAND = 2


class PressureSolver:
    """Poisson's equation  laplacian p = -d_i d_j (u_i u_j)  for the modes |k| <= `resolved` of a grid.

    Fields are given at `points` (m, 3), this rank's grid points, z slowest, and only the solenoidal part of their
    resolved modes counts: with a divergence, which scattered particles always leave in a field made of them, the
    pressure would depend on the mean velocity, and oscillate with it faster than particles can be stepped. Products of
    modes above a third of the number of cells alias; for fields known from particles that is far below the error of
    the highest modes themselves.

    Positions (n, 3) must lie in this rank's slab, or at most `reach` outside, which is `margin` grid planes.

    The adjoints take the derivatives of a scalar by what the method of that name returned, and give those by its
    field (m, 3) and by the positions (n, 3). All methods are collective.
    """

    def __init__(self, decomposition: SlabDecomposition, resolved: int, margin: int = 1) -> None:
        self.decomposition = decomposition
        self.grid = SpectralGrid(decomposition, cutoff=resolved)
        self._resolved, self._kept = resolved, self.grid.index_squared <= resolved**2
        shell = np.rint(np.sqrt(self.grid.index_squared)).astype(int)
        self._band, self._bands = np.where(shell > 0, (shell - 1) // BAND, -1), (resolved - 1) // BAND + 1
        self._band[shell > resolved] = -1
        self.reach = margin * decomposition.spacing
        self._spline = SplineInterpolation(self.grid, "cubic", margin)
        x, y, z = np.broadcast_arrays(*self.grid.coordinates())
        self.points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)

    def velocity_at(self, field: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """The resolved part of a field at positions: (n, 3)."""
        return self._spline.at(self._spline.coefficients(self._modes(field)), positions)

    def velocity_adjoint(self, field: np.ndarray, positions: np.ndarray,
                         weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Adjoint of `velocity_at`; weights (n, 3)."""
        coefficients = self._spline.coefficients(self._modes(field))
        by_field = self._on_points(self._spline.from_coefficients(self._spline.spread(weights, positions)))
        return by_field, self._spline.slope_along(coefficients, positions, weights)

    def pressure_at(self, field: np.ndarray, positions: np.ndarray) -> np.ndarray:
        """Pressure of the resolved field at positions: (n, 1)."""
        modes = pressure(self.grid, self._modes(field))
        return self._spline.at(self._spline.coefficients(modes[None]), positions)

    def pressure_adjoint(self, field: np.ndarray, positions: np.ndarray,
                         weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Adjoint of `pressure_at`; weights (n, 1)."""
        modes = self._modes(field)
        coefficients = self._spline.coefficients(pressure(self.grid, modes)[None])
        spread = self._spline.from_coefficients(self._spline.spread(weights, positions))
        by_field = self._on_points(pressure_adjoint(self.grid, modes, spread[0]))
        return by_field, self._spline.slope_along(coefficients, positions, weights)

    def force_at(self, field: np.ndarray, positions: np.ndarray, factors: np.ndarray) -> np.ndarray:
        """Pressure and force at positions, (n, 4): p, then -grad p - A div(grad u grad u^T) - D(k) u.

        `factors` (1 + m,): A, of the gradient model's stress, in length^2; and D, the rate at which modes are damped,
        at m wavenumbers equally spaced up to the highest that is resolved, linear between them and from D(0) = 0. A
        term whose factors are zero costs nothing here. In `force_adjoint` it costs as much as any, since the
        derivatives by its factors are not zero.
        """
        forces = self._pressure_and_force(self._modes(field), factors)
        return self._spline.at(self._spline.coefficients(forces), positions)

    def force_adjoint(self, field: np.ndarray, positions: np.ndarray, factors: np.ndarray,
                      weights: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Adjoint of `force_at`; weights (n, 4). Third, the derivatives by the factors, this rank's share of them."""
        grid, modes = self.grid, self._modes(field)
        coefficients = self._spline.coefficients(self._pressure_and_force(modes, factors))
        spread = self._spline.from_coefficients(self._spline.spread(weights, positions))
        # A derivative is antisymmetric: its transpose is itself with the other sign.
        by_modes = pressure_adjoint(grid, modes, spread[0] + divergence(grid, spread[1:]))
        by_modes -= factors[0] * gradient_stress_divergence_adjoint(grid, modes, spread[1:])
        by_modes -= self._damping(factors[1:]) * spread[1:]

        def along(term: np.ndarray) -> np.ndarray:
            """What each mode of a term of the force contributes to the derivative by its factor."""
            return grid.cells**3 * grid.multiplicity * np.sum((spread[1:].conj() * term).real, axis=0)

        by_factors = -np.append(np.sum(along(gradient_stress_divergence(grid, modes))),
                                self._damping_adjoint(along(modes), len(factors) - 1))
        return self._on_points(by_modes), self._spline.slope_along(coefficients, positions, weights), by_factors

    def band_energies(self, field: np.ndarray) -> np.ndarray:
        """Mean kinetic energy <u.u>/2 of the resolved field by bands of `BAND` wavenumber shells, from shell 1 on:
        (bands,), over all ranks."""
        energy = 0.5 * self.grid.multiplicity * np.sum(np.abs(self._modes(field)) ** 2, axis=0)
        inside = self._band >= 0
        return global_sum(self.grid.decomposition.comm,
                          np.bincount(self._band[inside], energy[inside], self._bands))

    def band_energies_adjoint(self, field: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """Adjoint of `band_energies`; weights (bands,), which must be those of all ranks together."""
        weight = np.append(weights, 0.0)[self._band]  # the mean has no band: -1 is the zero at the end
        return self._on_points(weight * self._modes(field)) / self.grid.cells**3

    def _modes(self, field: np.ndarray) -> np.ndarray:
        return project(self.grid, self._kept * self.grid.forward(field.T.reshape(3, *self.grid.physical_shape)))

    def _on_points(self, modes: np.ndarray) -> np.ndarray:
        """The resolved solenoidal part of a vector at the grid points, (m, 3): transpose of `_modes`, up to what both
        ways of the transform share."""
        return self.grid.backward(project(self.grid, self._kept * modes)).reshape(3, -1).T

    def _pressure_and_force(self, modes: np.ndarray, factors: np.ndarray) -> np.ndarray:
        grid, found = self.grid, pressure(self.grid, modes)
        force = -gradient(grid, found)
        if factors[0] != 0:
            force -= factors[0] * gradient_stress_divergence(grid, modes)
        if np.any(factors[1:]):
            force -= self._damping(factors[1:]) * modes
        return np.concatenate([found[None], force])

    def _damping(self, rates: np.ndarray) -> np.ndarray:
        """D of each mode."""
        below, fraction = self._places(len(rates))
        rates = np.append(0.0, rates)
        return (1 - fraction) * rates[below] + fraction * rates[below + 1]

    def _damping_adjoint(self, weights: np.ndarray, count: int) -> np.ndarray:
        """Adjoint of `_damping`: weights of each mode to those of the `count` rates."""
        below, fraction = self._places(count)
        spread = [np.bincount((below + above).ravel(), (share * weights).ravel(), count + 1)
                  for above, share in ((0, 1 - fraction), (1, fraction))]
        return sum(spread)[1:]

    def _places(self, count: int) -> tuple[np.ndarray, np.ndarray]:
        """Of each mode the interval of `count` between 0 and the highest resolved wavenumber, and the place in it."""
        places = np.sqrt(self.grid.index_squared) * (count / self._resolved)
        below = np.minimum(places.astype(int), count - 1)
        return below, np.minimum(places - below, 1.0)
