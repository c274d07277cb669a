"""Flows, and the march of a flow through time, for the tests and scripts of this folder."""

import numpy as np

from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.navier_stokes import CompressibleFluid
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import STEPPERS

# A small flow with tracers.
WITH_TRACERS = """
title = "decaying turbulence with tracers"
[flow]
fluid = "incompressible"
cells = 32
viscosity = 0.03
[initial]
kind = "random"
amplitude = 1.0
peak_wavenumber = 2
[tracers]
particles_per_side = 16
turnovers = 0.1
frame_interval = 0.02
field_every = 2
"""


def make_grid(comm, cells, precision="float64", cutoff=None):
    return SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells), precision, cutoff)


def turbulence(comm, cells, nu, c, precision="float64", rate=None):
    """A compressible fluid, of density that fits the pressure, whose velocity components have an rms of 1."""
    grid = make_grid(comm, cells, precision)
    velocity = initial_fields.random_velocity(grid, 3, 1.0, 2.0)
    state = np.concatenate([velocity, initial_fields.balanced_density(grid, velocity, c)[None]])
    forcing = None if rate is None else LinearForcing(grid, rate, 2.0)
    return CompressibleFluid(grid, nu, c, forcing), state.astype(grid.complex)


def march(fluid, state, step, count, stepper="etdrk4"):
    advance = STEPPERS[stepper](fluid)
    for _ in range(count):
        state = advance(state, step)
    return state
