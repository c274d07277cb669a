"""The two fluids, incompressible and weakly compressible isothermal, as du/dt = L u + N(u) in Fourier space."""

import math
from collections.abc import Callable

import numpy as np

from eddies.flow.forcing import LinearForcing
from eddies.flow.subgrid import Closure
from eddies.kernels.flow import Formulas
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import ScalarFunction, divided_difference


class Fluid:
    """Equations of a flow. A fluid of your own takes the same arguments; derive it from one of the two classes below.

    Parameters
    ----------
    grid : grid of the flow.
    viscosity : kinematic viscosity nu.
    sound_speed : c; infinite for an incompressible fluid.
    forcing : adds a force to the tendency du/dt of the velocity. The force ends when tracers are released, unless
        [tracers] forced = true.
    closure : adds the force of the scales that a coarse grid or a filter removes.

    A state is an array of modes. If `compressible`, it holds (u, v, w, s) with s = ln(rho / rho_0), (4, kz, ky, kx);
    otherwise it holds the velocity, (3, kz, ky, kx).
    """

    compressible: bool

    def __init__(self, grid: SpectralGrid, viscosity: float, sound_speed: float = math.inf,
                 forcing: LinearForcing | None = None, closure: Closure | None = None) -> None:
        self.grid, self.viscosity, self.sound_speed = grid, viscosity, sound_speed
        self.forcing, self.closure, self._formulas = forcing, closure, Formulas(grid.wavevector)


class IncompressibleFluid(Fluid):
    """The incompressible fluid, u_t = P[u x omega + f] + nu laplacian u, with the vorticity omega and a force f.

    P is the projection on solenoidal fields, which removes the gradient of p + |u|^2 / 2. The force of a closure is
    projected as well. An evaluation of N takes nine transforms. Ranks exchange data for only eight of them.
    """

    compressible = False

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        products = self.grid.multiply(state, self._formulas.cross, 3, fields=6, expand=self._with_vorticity,
                                      z_derivatives=2)
        if self.closure is not None:
            self.closure.add(state, products)
        tendency = self._formulas.project(products)
        if self.forcing is not None:
            self.forcing.add(state, tendency)
        return tendency

    def _with_vorticity(self, modes: np.ndarray) -> list[np.ndarray]:
        """Return u and curl u from u and the z derivatives of its first two components."""
        d_dx, d_dy = self.grid.d_dx, self.grid.d_dy
        u, v, w, du_dz, dv_dz = modes
        return [modes[:3], np.stack([d_dy[0] * w - dv_dz, du_dz - d_dx[0] * w, d_dx[0] * v - d_dy[0] * u])]

    def linear(self, state: np.ndarray) -> np.ndarray:
        return -self.viscosity * self.grid.wavenumber_squared * state

    def linear_function(self, function: ScalarFunction, step: float) -> np.ndarray:
        """Return f(step L) with f = `function`: a factor f(-nu k^2 step) of each mode with kz >= 0, (kz, ky, 1, kx)."""
        return functions_of_wavenumber(self.grid, lambda k2: [function(-self.viscosity * k2 * step).real])

    def combine(self, *terms: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return self._formulas.sum_of_decays(terms)


class CompressibleFluid(Fluid):
    """The fluid with p = c^2 rho and constant kinematic viscosity. Its equations for u and s = ln(rho / rho_0) are

        s_t = -div u - u.grad s
        u_t = -c^2 grad s + nu (laplacian u + 1/3 grad div u) - u.grad u + 2 nu (S - 1/3 div u).grad s + f

    S is the rate of strain and f a force. All nonlinear terms except the force of a closure are quadratic, so that they
    have no aliasing errors under the 2/3 rule. An evaluation of N takes fifteen backward transforms (u and the
    gradients of u and s) and four forward ones. Ranks exchange data for only eight of the backward ones, because
    derivatives along x and y are formed after that exchange.
    """

    compressible = True

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        tendency = self.grid.multiply(state, self._advection, 4, fields=15, expand=self._with_gradients,
                                      z_derivatives=4)
        if self.forcing is not None:
            self.forcing.add(state[:3], tendency[:3])
        if self.closure is not None:
            self.closure.add(state[:3], tendency[:3])
        return tendency

    def _with_gradients(self, modes: np.ndarray) -> list[np.ndarray]:
        """Return u, and the derivatives of (u, v, w, s) along x, along y and along z."""
        return [modes[:3], (self.grid.d_dx, modes[:4]), (self.grid.d_dy, modes[:4]), modes[4:]]

    def _advection(self, fields: np.ndarray, out: np.ndarray) -> None:
        self._formulas.advection(fields, self.viscosity, out)

    def linear(self, state: np.ndarray) -> np.ndarray:
        """Return the linear terms L u: the modes of -c^2 grad s - nu (k^2 u + 1/3 k (k.u)), then of -div u."""
        grid, nu = self.grid, self.viscosity
        velocity, s = state[:3], state[3]
        longitudinal = grid.along_wavevector(velocity)
        result = np.empty_like(state)
        for i, k in enumerate(grid.wavevector):
            viscous = grid.wavenumber_squared * velocity[i] + k * longitudinal / 3
            result[i] = -1j * self.sound_speed**2 * k * s - nu * viscous
        result[3] = -grid.divergence(velocity)
        return result

    def linear_function(self, function: ScalarFunction, step: float) -> np.ndarray:
        """Return f(step L) with f = `function`: five real factors of each mode with kz >= 0, (kz, ky, 5, kx).

        In this order they are transverse, excess, elastic, identity and coupling. They map a state (u, s) to (u', s'):

            u' = transverse u + k (excess k.u + elastic sigma),   sigma' = identity sigma - coupling k.u,   sigma = -i s

        L acts on the transverse velocity as -nu k^2, and on s and the longitudinal velocity as the matrix
        [[0, -ik], [-i c^2 k, -2 gamma]], gamma = 2/3 nu k^2, with the eigenvalues -gamma +- sqrt(gamma^2 - c^2 k^2).
        Let M be step times this matrix, z1 and z2 its eigenvalues, and f[z1, z2] the divided difference. Then
        f(M) = f[z1, z2] M + (f(z1) - z1 f[z1, z2]) I.
        """
        nu, c = self.viscosity, self.sound_speed

        def factors(k2: np.ndarray) -> list[np.ndarray]:
            gamma = 2 / 3 * nu * k2
            root = np.sqrt((gamma**2 - c**2 * k2).astype(complex))
            z1, z2 = step * (root - gamma), step * (-root - gamma)
            slope = divided_difference(function, z1, z2)
            identity = function(z1) - z1 * slope
            transverse = function(-nu * k2 * step).real
            difference = (identity - 4 / 3 * nu * k2 * step * slope).real - transverse
            excess = np.divide(difference, k2, out=np.zeros_like(k2), where=k2 > 0)
            return [transverse, excess, c**2 * step * slope.real, identity.real, step * slope.real]

        return functions_of_wavenumber(self.grid, factors)

    def combine(self, *terms: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        return self._formulas.sum_of_acoustic_blocks(terms)


def advective_speed(grid: SpectralGrid, velocity: np.ndarray) -> float:
    """Return the largest |u| + |v| + |w| at this rank's grid points, the speed in the advective Courant number.

    `velocity` holds modes. Collective.
    """
    return float(np.max([np.abs(u).sum(axis=0).max() for u in grid.blocks(velocity, fields=3)], initial=0.0))


def functions_of_wavenumber(grid: SpectralGrid, functions: Callable[[np.ndarray], list[np.ndarray]]) -> np.ndarray:
    """Return n real functions of k^2 at the modes with kz >= 0, (kz, ky, n, kx); modes with -kz have the same values.

    `functions` is called once, with the distinct values of k^2, and returns the list of the values of each function.
    """
    unit = 2 * np.pi / grid.decomposition.length
    index_squared = grid.index_squared[: grid.cutoff + 1]
    distinct = np.unique(index_squared)
    values = np.array(functions(unit**2 * distinct))
    table = np.zeros((len(values), 3 * grid.cutoff**2 + 1))
    table[:, distinct] = values
    return np.stack([row[index_squared].astype(grid.real) for row in table], axis=2)


#: The fluids by their names in [flow] fluid.
FLUIDS: dict[str, type[Fluid]] = {"incompressible": IncompressibleFluid, "compressible": CompressibleFluid}
