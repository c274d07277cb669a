"""Subgrid closures: models of how the scales that a coarse grid or a filter removes act on the resolved scales."""

from collections.abc import Callable

import numpy as np

from eddies.flow.statistics import energy_spectrum
from eddies.spectral.mode_operators import gaussian_transfer, rising
from eddies.spectral.spectral_grid import SpectralGrid

# How often each of the entries xx, yy, zz, xy, xz, yz occurs in a symmetric matrix.
TIMES = np.array([1, 1, 1, 2, 2, 2])
# Constants of nu_t (k_c / E(k_c))^(1/2) in `SpectralViscosity`: its value far below k_c, and the size and the rate of
# its exponential growth near k_c (Chollet and Lesieur 1981, in the form of Lesieur and Metais 1996, with the Kolmogorov
# constant 1.4).
PLATEAU, CUSP, STEEPNESS = 0.267, 34.5, 3.03


class Closure:
    """Base of all closures. Velocities and forces are modes (3, kz, ky, kx)."""

    def begin_step(self, velocity: np.ndarray) -> None:
        """Compute the quantities that stay constant during a step from the velocity at its start; collective."""

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to `tendency`, the rate of change of the velocity, in place."""
        raise NotImplementedError


class StressModel(Closure):
    """Force -div tau of the stress

        tau = (d^2/12) grad u grad u^T - 2 l^2 |S| S,    S = (grad u + grad u^T) / 2,   |S| = (2 S:S)^(1/2).

    The first part, the gradient part, is the leading term of the stress that a filter of width d hides (Leonard 1975;
    Clark et al. 1979). The second part is the stress of an eddy viscosity l^2 |S| with the mixing length l (Smagorinsky
    1963). It dissipates energy at the rate <2 l^2 |S| S:S>. Either l or d may be 0. The stress is computed at the grid
    points. The 2/3 rule does not remove the aliasing errors of |S|.

    Parameters
    ----------
    grid : grid of the velocity.
    mixing_length : l, which is C_s Delta in Smagorinsky's model.
    filter_width : d.
    """

    def __init__(self, grid: SpectralGrid, mixing_length: float = 0.0, filter_width: float = 0.0) -> None:
        self.grid, self.squared_length, self.squared_width = grid, mixing_length**2, filter_width**2

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        tendency -= self.grid.stress_divergence(self.stress(velocity))

    def stress(self, velocity: np.ndarray) -> np.ndarray:
        """Return the modes of tau, (6, kz, ky, kx) in the order xx, yy, zz, xy, xz, yz."""
        def tau(gradients: np.ndarray) -> np.ndarray:
            parts = []
            if self.squared_length:
                parts.append(-2 * self.squared_length * strain_product(gradients))
            if self.squared_width:
                parts.append(self.squared_width / 12 * gradient_product(gradients))
            return sum(parts, start=np.zeros(()))

        return self.modes_of(tau, velocity)

    def modes_of(self, formula: Callable[[np.ndarray], np.ndarray], velocity: np.ndarray) -> np.ndarray:
        """Return the modes (6, kz, ky, kx) of a formula of the velocity gradients.

        `formula` maps the gradients (9, ...) at grid points to values (6, ...).
        """
        grid = self.grid

        def gradients(modes: np.ndarray) -> list[np.ndarray]:
            return [(grid.d_dx, modes[:3]), (grid.d_dy, modes[:3]), modes[3:]]

        def product(values: np.ndarray, out: np.ndarray) -> None:
            out[...] = formula(values)

        return grid.multiply(velocity, product, 6, fields=9, expand=gradients, z_derivatives=3)


class DynamicStress(StressModel):
    """StressModel with one mixing length l for the box. Each step computes l at its start, from the resolved scales.

    The formula is (Germano et al. 1991; Lilly 1992; with the gradient part Vreman et al. 1994)

        l^2 = max(<(L - H):M> / <M:M>, 0),   L = (uu)^ - u^ u^,   M = 2 ((|S|S)^ - r |S^|S^).

    ^ denotes the test filter, S^ the rate of strain of u^, and <.> the mean over the box. The test filter acts on
    fields that have passed the first filter, the one of the simulation. Both together form the combined filter. r is
    the squared width of the combined filter divided by that of the first. H is the gradient part for the combined
    filter, minus the gradient part for the first filter, to which ^ is applied. If not `with_gradient`, the stress has
    no gradient part, and H = 0.

    With a filter width d, the first filter is Gaussian of width d, ^ is Gaussian of width 2 d, and r = 5. If the filter
    width is 0, the first filter is the grid, and ^ removes the modes above half the highest wavenumber of the grid. The
    tensors L, H and M then have only the modes up to this wavenumber.
    """

    def __init__(self, grid: SpectralGrid, filter_width: float, with_gradient: bool = False) -> None:
        super().__init__(grid, 0.0, filter_width if with_gradient else 0.0)
        if filter_width:
            self.test, self.ratio = gaussian_transfer(grid.wavenumber_squared, 2 * filter_width).astype(grid.real), 5.0
        else:
            half = grid.cutoff // 2
            below = [np.abs(axis) <= half for axis in grid.index]
            self.test = (below[0] & below[1] & below[2]).astype(grid.real)
            self.ratio = (grid.cutoff / half) ** 2

    def begin_step(self, velocity: np.ndarray) -> None:
        test, coarser = self.test, self.test * velocity
        hidden = test * self.grid.squares(velocity) - self.grid.squares(coarser)
        strain, coarser_strain = (self.modes_of(strain_product, u) for u in (velocity, coarser))
        model = 2 * (test * strain - self.ratio * coarser_strain)
        if self.squared_width:
            products, coarser_products = (self.modes_of(gradient_product, u) for u in (velocity, coarser))
            hidden -= self.squared_width / 12 * (self.ratio * coarser_products - test * products)
        numerator, norm = (self._contraction(tensor, model) for tensor in (hidden, model))
        self.squared_length = max(numerator / norm, 0.0) if norm > 0 else 0.0

    def _contraction(self, one: np.ndarray, other: np.ndarray) -> float:
        """Return <A:B> of two symmetric tensors given by modes (6, ...). Only modes that pass the test filter count."""
        products = np.tensordot(TIMES, (one.conj() * other).real, axes=1)
        return self.grid.sum_modes(np.where(self.test > 0, products, 0))


class ModeDamping(Closure):
    """Force -a D(k) u with a fixed function D (kz, ky, kx). `begin_step` computes the amplitude a."""

    def __init__(self, grid: SpectralGrid, shape: np.ndarray) -> None:
        self.grid, self.shape, self.amplitude = grid, shape, 0.0

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        tendency -= (self.amplitude * self.shape).astype(self.grid.real) * velocity


class SpectralViscosity(ModeDamping):
    """Force -nu_t(k) k^2 u with the eddy viscosity of a sharp cut-off at k_c (Chollet and Lesieur 1981):

        nu_t = 0.267 (E(k_c)/k_c)^(1/2) (1 + 34.5 exp(-3.03 k_c/k)).

    k_c is the highest wavenumber of the grid along each axis. E(k_c) is the energy of the last shell of modes that the
    grid holds completely.
    """

    def __init__(self, grid: SpectralGrid) -> None:
        k = np.sqrt(np.maximum(grid.wavenumber_squared, 1))
        super().__init__(grid, PLATEAU * (1 + CUSP * np.exp(-STEEPNESS * grid.cutoff / k)) * grid.wavenumber_squared)

    def begin_step(self, velocity: np.ndarray) -> None:
        self.amplitude = np.sqrt(energy_spectrum(self.grid, velocity)[self.grid.cutoff] / self.grid.cutoff)


class EddyDamping(ModeDamping):
    """Force -D(k) u with the learned damping D of the particle model.

    D = k_c u_c f(k). The function f has the values `rates` at wavenumbers that are equally spaced up to k_c. It is
    linear between these wavenumbers, and f(0) = 0. k_c is the highest wavenumber of the grid. u_c is the rms of a
    velocity component in the modes above k_c/2.
    """

    def __init__(self, grid: SpectralGrid, rates: np.ndarray) -> None:
        self._small = grid.index_squared > (grid.cutoff / 2) ** 2
        super().__init__(grid, grid.cutoff * rising(np.sqrt(grid.index_squared), grid.cutoff, rates))

    def begin_step(self, velocity: np.ndarray) -> None:
        self.amplitude = np.sqrt(self.grid.sum_modes(self._small * (np.abs(velocity) ** 2).sum(axis=0)) / 3)


def strain_product(gradients: np.ndarray) -> np.ndarray:
    """Return |S| S (6, ...) from velocity gradients (9, ...) in the order du/dx, dv/dx, dw/dx, du/dy, ..."""
    d_dx, d_dy, d_dz = gradients.reshape(3, 3, *gradients.shape[1:])
    strain = np.stack([d_dx[0], d_dy[1], d_dz[2],
                       (d_dx[1] + d_dy[0]) / 2, (d_dx[2] + d_dz[0]) / 2, (d_dy[2] + d_dz[1]) / 2])
    squared = (strain[:3] ** 2).sum(axis=0) + 2 * (strain[3:] ** 2).sum(axis=0)
    return np.sqrt(2 * squared) * strain


def gradient_product(gradients: np.ndarray) -> np.ndarray:
    """Return d_k u_i d_k u_j (6, ...) from velocity gradients (9, ...) in the order du/dx, dv/dx, dw/dx, du/dy, ..."""
    u, v, w = np.moveaxis(gradients.reshape(3, 3, *gradients.shape[1:]), 1, 0)
    return np.stack([(a * b).sum(axis=0) for a, b in ((u, u), (v, v), (w, w), (u, v), (u, w), (v, w))])
