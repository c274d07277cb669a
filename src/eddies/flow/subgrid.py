"""What the scales that a coarse grid, or a filter, leaves out do to the others.

A closure adds its force to the tendency of the velocity, both (3, kz, ky, kx) in Fourier space. What it finds once a
step, `begin_step` takes from the velocity at the start of it.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from eddies.flow.statistics import energy_spectrum
from eddies.spectral.mode_operators import gaussian_transfer, rising
from eddies.spectral.spectral_grid import SpectralGrid

# How often each entry xx, yy, zz, xy, xz, yz stands in a symmetric matrix.
TIMES = np.array([1, 1, 1, 2, 2, 2])
# nu_t (k_c / E(k_c))^(1/2) far below k_c, its growth towards k_c, and how fast it grows (Chollet and Lesieur 1981, in
# the form of Lesieur and Metais 1996, Kolmogorov constant 1.4).
PLATEAU, CUSP, STEEPNESS = 0.267, 34.5, 3.03


class Closure(Protocol):
    """What a fluid is told of the scales that its grid leaves out."""

    def begin_step(self, velocity: np.ndarray) -> None:
        """Find what a step keeps; all ranks call it."""

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's tendency in place."""


class StressModel:
    """The force -div tau of the stress

        tau = (d^2/12) grad u grad u^T - 2 l^2 |S| S,    S = (grad u + grad u^T) / 2,   |S| = (2 S:S)^(1/2).

    The first part is the leading term of the stress that a filter of width d hides (Leonard 1975; Clark et al. 1979),
    the second an eddy viscosity l^2 |S| with the mixing length l (Smagorinsky 1963), which takes the energy
    <2 l^2 |S| S:S>; either may be 0. The stress is formed at the grid points; what is not a polynomial the 2/3 rule
    does not free of aliasing.

    Parameters
    ----------
    grid : of the velocity.
    mixing_length : l, C_s Delta in Smagorinsky's model.
    filter_width : d.
    """

    def __init__(self, grid: SpectralGrid, mixing_length: float = 0.0, filter_width: float = 0.0) -> None:
        self.grid, self.squared_length, self.squared_width = grid, mixing_length**2, filter_width**2

    def begin_step(self, velocity: np.ndarray) -> None:
        """Nothing is kept."""

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's tendency in place; both (3, kz, ky, kx), Fourier space."""
        tendency -= self.grid.stress_divergence(self.stress(velocity))

    def stress(self, velocity: np.ndarray) -> np.ndarray:
        """Modes of tau, (6, kz, ky, kx) in the order xx, yy, zz, xy, xz, yz."""
        return self._of_gradients(velocity, self._stress)

    def _of_gradients(self, velocity: np.ndarray, product, results: int = 6) -> np.ndarray:
        """Modes of what `product` makes of the gradients (9, ...), components within directions, at the points."""
        return self.grid.multiply(velocity, product, results, fields=9, expand=self._gradients, z_derivatives=3)

    def _gradients(self, modes: np.ndarray) -> list[np.ndarray]:
        """Derivatives of the velocity along x, along y and along z."""
        return [(self.grid.d_dx, modes[:3]), (self.grid.d_dy, modes[:3]), modes[3:]]

    def _stress(self, gradients: np.ndarray, out: np.ndarray) -> None:
        out[...] = 0
        if self.squared_length:
            out -= 2 * self.squared_length * strain_product(gradients)
        if self.squared_width:
            out += self.squared_width / 12 * gradient_product(gradients)


class DynamicStress(StressModel):
    """The same with a mixing length that is found at the start of each step from the resolved scales themselves
    (Germano et al. 1991; Lilly 1992; with the first part Vreman et al. 1994), one for the whole box:

        l^2 = max(<(L - H):M> / <M:M>, 0),   L = (uu)^ - u^ u^,   M = 2 ((|S|S)^ - r |S^|S^),

    H the first part of the stress for both filters together less the same for the first, filtered. ^ is a second
    filter, and r the square of the ratio of widths, of both together to the first. Without a filter width the grid is
    the first filter and ^ cuts off above half its highest wavenumber; all tensors then have the modes below alone.
    Otherwise the first is Gaussian of width d, ^ is Gaussian of 2 d, and r = 5.
    """

    def __init__(self, grid: SpectralGrid, filter_width: float = 0.0, with_gradient: bool = False) -> None:
        super().__init__(grid, 0.0, filter_width if with_gradient else 0.0)
        if filter_width:
            self.test, self.ratio = gaussian_transfer(grid.wavenumber_squared, 2 * filter_width).astype(grid.real), 5.0
        else:
            half = grid.cutoff // 2
            below = [np.abs(axis) <= half for axis in grid.index]
            self.test = (below[0] & below[1] & below[2]).astype(grid.real)
            self.ratio = (grid.cutoff / half) ** 2

    def begin_step(self, velocity: np.ndarray) -> None:
        """Find the mixing length; collective."""
        test, coarser = self.test, self.test * velocity
        hidden = test * self.grid.squares(velocity) - self.grid.squares(coarser)
        strain, coarser_strain = (self._of_gradients(u, _into(strain_product)) for u in (velocity, coarser))
        model = 2 * (test * strain - self.ratio * coarser_strain)
        if self.squared_width:
            products, coarser_products = (self._of_gradients(u, _into(gradient_product)) for u in (velocity, coarser))
            hidden -= self.squared_width / 12 * (self.ratio * coarser_products - test * products)
        found, norm = (self._contraction(tensor, model) for tensor in (hidden, model))
        self.squared_length = max(found / norm, 0.0) if norm > 0 else 0.0

    def _contraction(self, one: np.ndarray, other: np.ndarray) -> float:
        """<A:B> of symmetric tensors, over the modes that the second filter leaves."""
        products = np.tensordot(TIMES, (one.conj() * other).real, axes=1)
        return self.grid.sum_modes(np.where(self.test > 0, products, 0))


class SpectralViscosity:
    """-nu_t(k) k^2 u with the eddy viscosity of modes beyond a sharp cut-off at k_c (Chollet and Lesieur 1981),

        nu_t = 0.267 (E(k_c)/k_c)^(1/2) (1 + 34.5 exp(-3.03 k_c/k)),

    E(k_c) the energy of the last shell that the grid holds as a whole.
    """

    def __init__(self, grid: SpectralGrid) -> None:
        self.grid = grid
        k = np.sqrt(np.maximum(grid.wavenumber_squared, 1))
        self._shape = PLATEAU * (1 + CUSP * np.exp(-STEEPNESS * grid.cutoff / k)) * grid.wavenumber_squared
        self._rate = 0.0

    def begin_step(self, velocity: np.ndarray) -> None:
        """Find E(k_c); collective."""
        _, energy = energy_spectrum(self.grid, velocity)
        self._rate = np.sqrt(energy[self.grid.cutoff] / self.grid.cutoff)

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's tendency in place."""
        tendency -= (self._rate * self._shape).astype(self.grid.real) * velocity


class EddyDamping:
    """-D(k) u,  D = k_c u_c times rates at wavenumbers equally spaced up to k_c, linear between them and from D(0) = 0.

    The particle model learns such rates. u_c is the rms of a component of the modes above k_c/2, as they are at the
    start of a step, k_c the highest wavenumber of the grid.
    """

    def __init__(self, grid: SpectralGrid, rates: np.ndarray) -> None:
        self.grid, self._small = grid, grid.index_squared > (grid.cutoff / 2) ** 2
        self._shape = grid.cutoff * rising(np.sqrt(grid.index_squared), grid.cutoff, rates)
        self._speed = 0.0

    def begin_step(self, velocity: np.ndarray) -> None:
        """Find u_c; collective."""
        self._speed = np.sqrt(self.grid.sum_modes(self._small * (np.abs(velocity) ** 2).sum(axis=0)) / 3)

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's tendency in place."""
        tendency -= (self._speed * self._shape).astype(self.grid.real) * velocity


def strain_product(gradients: np.ndarray) -> np.ndarray:
    """|S| S (6, ...) of velocity gradients (9, ...), components within directions."""
    d_dx, d_dy, d_dz = gradients.reshape(3, 3, *gradients.shape[1:])
    strain = np.stack([d_dx[0], d_dy[1], d_dz[2],
                       (d_dx[1] + d_dy[0]) / 2, (d_dx[2] + d_dz[0]) / 2, (d_dy[2] + d_dz[1]) / 2])
    squared = (strain[:3] ** 2).sum(axis=0) + 2 * (strain[3:] ** 2).sum(axis=0)
    return np.sqrt(2 * squared) * strain


def gradient_product(gradients: np.ndarray) -> np.ndarray:
    """d_k u_i d_k u_j (6, ...) of velocity gradients (9, ...), components within directions."""
    u, v, w = np.moveaxis(gradients.reshape(3, 3, *gradients.shape[1:]), 1, 0)
    return np.stack([(a * b).sum(axis=0) for a, b in ((u, u), (v, v), (w, w), (u, v), (u, w), (v, w))])


def _into(function):
    """The function with its result written to an argument."""
    def write(gradients: np.ndarray, out: np.ndarray) -> None:
        out[...] = function(gradients)
    return write
