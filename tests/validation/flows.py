"""Flows, and the march of a flow through time, for the tests of the solver."""

import numpy as np

from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.navier_stokes import CompressibleFluid
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import STEPPERS


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
