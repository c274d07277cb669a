"""The two fluids: incompressible, and weakly compressible isothermal. Both as du/dt = L u + N(u) in Fourier space."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Protocol

import numpy as np

from eddies.flow.forcing import LinearForcing
from eddies.flow.subgrid import Closure
from eddies.kernels.flow import Formulas
from eddies.kernels.library import library
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import ScalarFunction, divided_difference


class Fluid(Protocol):
    """What the direct simulation solves, built as Fluid(grid, viscosity, sound_speed, forcing); a class of your own
    best derives from one of the two below.

    `compressible`: the state is (u, v, w, s), s = ln(rho / rho_0), as modes (4, kz, ky, kx); otherwise the velocity
    alone, (3, kz, ky, kx), and the sound speed is infinite. `forcing` is None, or adds to a tendency; it is removed
    when tracers are released. Steppers and statistics read these attributes.
    """

    compressible: bool
    grid: SpectralGrid
    viscosity: float
    sound_speed: float
    forcing: LinearForcing | None

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        """N(u), with the forcing."""

    def linear(self, state: np.ndarray) -> np.ndarray:
        """L u."""

    def linear_function(self, function: ScalarFunction, step: float) -> Any:
        """f(step L), in a form that `combine` applies."""

    def combine(self, *terms: tuple[Any, np.ndarray]) -> np.ndarray:
        """The sum of linear functions applied to states."""


class IncompressibleFluid:
    """u_t = P[u x omega + f] + nu laplacian u,  P the projection on solenoidal fields (it absorbs p + |u|^2 / 2).

    A large-eddy simulation adds the force of a `closure`, within the projection. The state is the velocity,
    (3, kz, ky, kx). Nine transforms an evaluation, of which eight are sent.
    """

    compressible, transforms = False, 9

    def __init__(self, grid: SpectralGrid, viscosity: float, sound_speed: float = math.inf,
                 forcing: LinearForcing | None = None, closure: Closure | None = None) -> None:
        self.grid, self.viscosity, self.sound_speed = grid, viscosity, sound_speed
        self.forcing, self.closure, self._formulas = forcing, closure, Formulas(library(), grid.wavevector)

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        """P[u x omega + f]."""
        products = self.grid.multiply(state, self._formulas.cross, 3, fields=6, expand=self._with_vorticity,
                                      z_derivatives=2)
        if self.closure is not None:
            self.closure.add(state, products)
        tendency = self._formulas.project(products)
        if self.forcing is not None:
            self.forcing.add(state, tendency)
        return tendency

    def _with_vorticity(self, modes: np.ndarray) -> list[np.ndarray]:
        """u and curl u from u and the z derivatives of its first two components."""
        d_dx, d_dy = self.grid.d_dx, self.grid.d_dy
        u, v, w, du_dz, dv_dz = modes
        return [modes[:3], np.stack([d_dy[0] * w - dv_dz, du_dz - d_dx[0] * w, d_dx[0] * v - d_dy[0] * u])]

    def linear(self, state: np.ndarray) -> np.ndarray:
        """-nu k^2 u."""
        return -self.viscosity * self.grid.wavenumber_squared * state

    def linear_function(self, function: ScalarFunction, step: float) -> Decay:
        """f(step L), which multiplies each mode by f(-nu k^2 step)."""
        return Decay(self.grid, lambda k2: function(-self.viscosity * k2 * step).real)

    def combine(self, *terms: tuple[Decay, np.ndarray]) -> np.ndarray:
        """The sum of linear functions applied to states."""
        return self._formulas.sum_of_decays([(operator.factors, state) for operator, state in terms])


class CompressibleFluid:
    """The barotropic fluid p = c^2 rho with constant kinematic viscosity, in s = ln(rho / rho_0):

        s_t = -div u - u.grad s
        u_t = -c^2 grad s + nu (laplacian u + 1/3 grad div u) - u.grad u + 2 nu (S - 1/3 div u).grad s + f

    S is the rate of strain; a large-eddy simulation adds the force of a `closure`. Everything else
    nonlinear is quadratic, so the 2/3 rule dealiases it exactly. The state is (u, v, w, s), (4, kz, ky, kx). Fifteen
    transforms back (u and the gradients of u and s), four forth; of the first eight are sent, because derivatives along
    x and y are taken after the transform along z.
    """

    compressible, transforms = True, 19

    def __init__(self, grid: SpectralGrid, viscosity: float, sound_speed: float,
                 forcing: LinearForcing | None = None, closure: Closure | None = None) -> None:
        self.grid, self.viscosity, self.sound_speed = grid, viscosity, sound_speed
        self.forcing, self.closure, self._formulas = forcing, closure, Formulas(library(), grid.wavevector)

    def nonlinear(self, state: np.ndarray) -> np.ndarray:
        """-u.grad u + 2 nu (S - 1/3 div u).grad s + f, and -u.grad s."""
        tendency = self.grid.multiply(state, self._advection, 4, fields=15, expand=self._with_gradients,
                                      z_derivatives=4)
        if self.forcing is not None:
            self.forcing.add(state[:3], tendency[:3])
        if self.closure is not None:
            self.closure.add(state[:3], tendency[:3])
        return tendency

    def _with_gradients(self, modes: np.ndarray) -> list[np.ndarray]:
        """u, and the derivatives of (u, v, w, s) along x, along y and along z."""
        return [modes[:3], (self.grid.d_dx, modes[:4]), (self.grid.d_dy, modes[:4]), modes[4:]]

    def _advection(self, fields: np.ndarray, out: np.ndarray) -> None:
        self._formulas.advection(fields, self.viscosity, out)

    def linear(self, state: np.ndarray) -> np.ndarray:
        """-c^2 grad s - nu (k^2 u + 1/3 k (k.u)), and -div u."""
        grid, nu = self.grid, self.viscosity
        velocity, s = state[:3], state[3]
        longitudinal = grid.along_wavevector(velocity)
        result = np.empty_like(state)
        for i, k in enumerate(grid.wavevector):
            viscous = grid.wavenumber_squared * velocity[i] + k * longitudinal / 3
            result[i] = -1j * self.sound_speed**2 * k * s - nu * viscous
        result[3] = -grid.divergence(velocity)
        return result

    def linear_function(self, function: ScalarFunction, step: float) -> AcousticBlock:
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

        def transverse(k2: np.ndarray) -> np.ndarray:
            return function(-nu * k2 * step).real

        def excess(k2: np.ndarray) -> np.ndarray:
            slope, constant = block(k2)
            difference = (constant - 4 / 3 * nu * k2 * step * slope).real - transverse(k2)
            return np.divide(difference, k2, out=np.zeros_like(k2), where=k2 > 0)

        return AcousticBlock(grid, transverse=transverse, excess=excess, identity=lambda k2: block(k2)[1].real,
                             coupling=lambda k2: step * block(k2)[0].real,
                             elastic=lambda k2: c**2 * step * block(k2)[0].real)

    def combine(self, *terms: tuple[AcousticBlock, np.ndarray]) -> np.ndarray:
        """The sum of linear functions applied to states."""
        return self._formulas.sum_of_acoustic_blocks([(operator.factors, state) for operator, state in terms])


def advective_speed(grid: SpectralGrid, velocity: np.ndarray) -> float:
    """Largest |u| + |v| + |w| on this rank's grid points: the speed of the advective Courant number."""
    return float(np.max([np.abs(u).sum(axis=0).max() for u in grid.blocks(velocity, fields=3)], initial=0.0))


class Decay:
    """Multiplies each mode by a real function of k^2. As all factors here, that depends on |k| only, so planes kz < 0
    share those of kz > 0."""

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


#: The fluids that [flow] fluid names by a word.
FLUIDS: dict[str, type[Fluid]] = {"incompressible": IncompressibleFluid, "compressible": CompressibleFluid}
