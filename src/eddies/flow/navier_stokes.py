"""The two fluids: incompressible, and weakly compressible isothermal. Both as du/dt = L u + N(u) in Fourier space."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from eddies.flow.forcing import LinearForcing
from eddies.flow.operators import curl, divergence, dot_wavevector, gradient, project
from eddies.flow.spectral_grid import SpectralGrid
from eddies.time_stepping import ScalarFunction, divided_difference

Operator = Callable[[np.ndarray], np.ndarray]


class IncompressibleFluid:
    """u_t = P[u x omega + f] + nu laplacian u,  P the projection on solenoidal fields (it absorbs p + |u|^2 / 2).

    The state is the velocity, (3, kz, ky, kx). Nine transforms an evaluation.
    """

    def __init__(self, grid: SpectralGrid, viscosity: float, forcing: LinearForcing | None = None) -> None:
        self.grid, self.viscosity, self.forcing = grid, viscosity, forcing

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        """P[u x omega + f]."""
        u, v, w, p, q, r = self.grid.backward(np.concatenate([state, curl(self.grid, state)]))
        tendency = project(self.grid, self.grid.forward(np.stack([v * r - w * q, w * p - u * r, u * q - v * p])))
        if self.forcing is not None:
            self.forcing.add(state, tendency)
        return tendency

    def linear(self, state: np.ndarray) -> np.ndarray:
        """-nu k^2 u."""
        return -self.viscosity * self.grid.wavenumber_squared * state

    def linear_function(self, function: ScalarFunction, step: float) -> Operator:
        """f(step L), which multiplies each mode by f(-nu k^2 step)."""
        factor = by_wavenumber(self.grid, lambda k2: function(-self.viscosity * k2 * step).real)
        return lambda state: factor * state


class CompressibleFluid:
    """The barotropic fluid p = c^2 rho with constant kinematic viscosity, in s = ln(rho / rho_0):

        s_t = -div u - u.grad s
        u_t = -c^2 grad s + nu (laplacian u + 1/3 grad div u) - u.grad u + 2 nu (S - 1/3 div u).grad s + f

    S is the rate of strain. Everything nonlinear is quadratic, so the 2/3 rule dealiases it exactly. The state is
    (u, v, w, s), (4, kz, ky, kx). Fifteen transforms back (u and the gradients of u and s), four forth.
    """

    def __init__(self, grid: SpectralGrid, viscosity: float, sound_speed: float,
                 forcing: LinearForcing | None = None) -> None:
        self.grid, self.viscosity, self.sound_speed, self.forcing = grid, viscosity, sound_speed, forcing

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        """-u.grad u + 2 nu (S - 1/3 div u).grad s + f, and -u.grad s."""
        spectral = np.concatenate([state[:3], *(gradient(self.grid, component) for component in state)])
        physical = self.grid.backward(spectral)
        u, A, G = physical[:3], physical[3:12].reshape(3, 3, *physical.shape[1:]), physical[12:]
        nu = self.viscosity
        # u.grad u - 2 nu S.grad s = A (u - nu G) - nu A^T G  with A_ij = d_j u_i
        w = u - nu * G if nu > 0 else u
        product = np.empty((4, *physical.shape[1:]), physical.dtype)
        for i in range(3):
            product[i] = -(A[i, 0] * w[0] + A[i, 1] * w[1] + A[i, 2] * w[2])
            if nu > 0:
                product[i] += nu * (A[0, i] * G[0] + A[1, i] * G[1] + A[2, i] * G[2])
                product[i] -= (2 / 3 * nu) * ((A[0, 0] + A[1, 1] + A[2, 2]) * G[i])
        product[3] = -(u[0] * G[0] + u[1] * G[1] + u[2] * G[2])
        tendency = self.grid.forward(product)
        if self.forcing is not None:
            self.forcing.add(state[:3], tendency[:3])
        return tendency

    def linear(self, state: np.ndarray) -> np.ndarray:
        """-c^2 grad s - nu (k^2 u + 1/3 k (k.u)), and -div u."""
        grid, nu = self.grid, self.viscosity
        velocity, s = state[:3], state[3]
        longitudinal = dot_wavevector(grid, velocity)
        result = np.empty_like(state)
        for i, k in enumerate(grid.wavevector):
            viscous = grid.wavenumber_squared * velocity[i] + k * longitudinal / 3
            result[i] = -1j * self.sound_speed**2 * k * s - nu * viscous
        result[3] = -divergence(grid, velocity)
        return result

    def linear_function(self, function: ScalarFunction, step: float) -> Operator:
        """f(step L): on transverse velocity f(-nu k^2 step); on (s, longitudinal u) the function of a 2 x 2 block.

        The block [[0, -ik], [-i c^2 k, -2 gamma]], gamma = 2/3 nu k^2, has the eigenvalues
        -gamma +- sqrt(gamma^2 - c^2 k^2); with M = step * block,  f(M) = f[z1, z2] M + (f(z1) - z1 f[z1, z2]) I.
        """
        grid, nu, c = self.grid, self.viscosity, self.sound_speed

        def block(k2: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            gamma = 2 / 3 * nu * k2
            root = np.sqrt((gamma**2 - c**2 * k2).astype(complex))
            z1, z2 = step * (root - gamma), step * (-root - gamma)
            slope = divided_difference(function, z1, z2)
            return slope, (function(z1) - z1 * slope)

        transverse = by_wavenumber(grid, lambda k2: function(-nu * k2 * step).real)
        identity = by_wavenumber(grid, lambda k2: block(k2)[1].real)
        coupling = by_wavenumber(grid, lambda k2: step * block(k2)[0].real)

        def longitudinal_excess(k2: np.ndarray) -> np.ndarray:
            slope, constant = block(k2)
            excess = constant - 4 / 3 * nu * k2 * step * slope - function(-nu * k2 * step)
            return np.divide(excess.real, k2, out=np.zeros_like(k2), where=k2 > 0)

        excess = by_wavenumber(grid, longitudinal_excess)
        elastic = (c**2 * coupling).astype(grid.real)

        def apply(state: np.ndarray) -> np.ndarray:
            velocity, s = state[:3], state[3]
            dotted = dot_wavevector(grid, velocity)
            along = excess * dotted - 1j * (elastic * s)
            result = np.empty_like(state)
            for i, k in enumerate(grid.wavevector):
                np.multiply(transverse, velocity[i], out=result[i])
                result[i] += k * along
            result[3] = identity * s - 1j * (coupling * dotted)
            return result

        return apply


def by_wavenumber(grid: SpectralGrid, function: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """A real function of k^2 on all modes of this rank, evaluated once for each integer |k|^2: (kz, ky, kx)."""
    unit = 2 * np.pi / grid.decomposition.length
    distinct = np.unique(grid.index_squared)
    table = np.zeros(3 * grid.cutoff**2 + 1)
    if len(distinct):
        table[distinct] = function(unit**2 * distinct)
    return table[grid.index_squared].astype(grid.real)


def advective_speed(grid: SpectralGrid, velocity: np.ndarray) -> float:
    """Largest |u| + |v| + |w| on this rank's grid points: the speed of the advective Courant number."""
    return float(np.abs(grid.backward(velocity)).sum(axis=0).max(initial=0.0))
