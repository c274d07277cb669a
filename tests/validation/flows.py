"""Flows, and the march of a flow through time, for the tests of the solver."""

import numpy as np

from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import STEPPERS, phi

WAVE, STEPS = 1e-6, 20  # amplitude of a wave, whose square, its effect on itself, is negligible; steps


def make_grid(comm, cells, precision="float64", cutoff=None):
    return SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells), precision, cutoff)


def turbulence(comm, cells, nu=0.05, c=8.0, precision="float64", rate=None):
    """A compressible fluid and a random state in balance; velocity components have the rms 1."""
    grid = make_grid(comm, cells, precision)
    velocity = initial_fields.random_velocity(grid, 3, 1.0, 2.0)
    forcing = None if rate is None else LinearForcing(grid, rate, 2.0)
    return CompressibleFluid(grid, nu, c, forcing), with_density(grid, velocity, c)


def with_density(grid, velocity, c):
    """The state of a compressible fluid with this velocity and the density that fits its pressure."""
    density = initial_fields.balanced_density(grid, velocity, c)
    return np.concatenate([velocity, density[None]]).astype(grid.complex)


def march(fluid, state, step, count, stepper="etdrk4"):
    advance = STEPPERS[stepper](fluid)
    for _ in range(count):
        state = advance(state, step)
    return state


def amplification(stepper, z, w):
    """Amplification of u in a step, for u' = L u + i a u with z = step L and w = step a of equal shape."""
    z, w = np.asarray(z, complex), 1j * np.asarray(w)
    if stepper == "rk4":
        return sum((z + w) ** n / factorial for n, factorial in enumerate((1, 1, 2, 6, 24)))
    full, half, q = np.exp(z), np.exp(z / 2), phi(1, z / 2) / 2
    p1, p2, p3 = (phi(order, z) for order in (1, 2, 3))
    a = half + q * w
    b = half + q * w * a
    c = half * a + q * w * (2 * b - 1)
    return full + w * ((p1 - 3 * p2 + 4 * p3) + (2 * p2 - 4 * p3) * (a + b) + (4 * p3 - p2) * c)


def measured_growth(comm, stepper, advection, viscosity=0.0, sound=0.0):
    """Largest growth a step of waves of k_max in a uniform flow along x, from step k U, step nu k^2 and step c k.

    Each is an eigenvector of advection, sound and viscosity, so a step multiplies it by the `amplification`.
    """
    grid = make_grid(comm, 8)
    k, here, step = grid.cutoff, 0 in grid.index[1], 1.0  # only the rank with ky = 0 holds the wave
    state = np.zeros((4 if sound else 3, *grid.spectral_shape), complex)
    if here:
        state[0, 0, 0, 0] = advection / k
        state[0 if sound else 1, 0, 0, k] = WAVE
    fluid = CompressibleFluid(grid, 0.0, sound / k) if sound else IncompressibleFluid(grid, viscosity / k**2)

    def amplitudes(state):
        """Amplitudes of the eigenmodes: sound to the right and to the left, or the transverse velocity."""
        u, v, s = (state[i, 0, 0, k] if here else 0j for i in (0, 1, -1))
        c = sound / k
        return np.abs(global_sum(comm, [u + c * s, u - c * s] if sound else [v]))

    end = march(fluid, state, step, STEPS, stepper)
    return float(np.max(amplitudes(end) / amplitudes(state)) ** (1 / STEPS))
