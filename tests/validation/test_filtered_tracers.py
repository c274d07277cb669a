"""Accelerations of tracers in a filtered direct simulation against those of the resolved terms.

Nothing is fitted: the terms are pressure, hidden stress and molecular viscosity. The stress brings the model closer to
the tracers, but only together with its pressure. Undoing the filter beats the leading term of its expansion.
"""

import numpy as np
import pytest
import torch
from flows import make_grid, march
from mpi4py import MPI

from eddies.flow import initial_fields
from eddies.flow.navier_stokes import IncompressibleFluid
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.time_stepping import ETDRK4
from tests.particles.configurations import LENGTH, model

CELLS, PER_SIDE, PLANES, VISCOSITY, STEP = 32, 24, 42, 0.03, 0.02
WIDTH = 2 * LENGTH / PER_SIDE


def frames_of_tracers(grid):
    """Position and velocity of tracers in decaying turbulence, by id, at three successive times after 0.6."""
    fluid = IncompressibleFluid(grid, VISCOSITY)
    state, advance = march(fluid, initial_fields.random_velocity(grid, 5, 1.0, 1.5), 0.06, 10), ETDRK4(fluid)
    columns = release(grid.decomposition, 3, PER_SIDE**3, "lattice")
    tracers = TracerParticles(FilteredField(grid, WIDTH, "quintic"), columns, state)
    found = []
    for _ in range(3):
        order = np.argsort(tracers.columns["id"])
        found.append({name: column[order] for name, column in tracers.columns.items()})
        state = advance(state, STEP)
        tracers.advance(state, STEP)
    return found


@torch.no_grad()
def modelled(now, *words, form="deconvolution"):
    """Accelerations of a model with these terms, and the resolved flow."""
    scales = ReferenceScales(filter_width=WIDTH, spacing=LENGTH / PER_SIDE, velocity=0.6, density_mean=1.0,
                             density=0.01, acceleration=1.0, density_rate=0.05, sound_speed=10.0, viscosity=VISCOSITY)
    settings = {word: dict(form=form) if word == "stress" else {} for word in words}
    dynamics = ParticleDynamics(SlabDecomposition(MPI.COMM_SELF, LENGTH, PLANES),
                                model(settings, FlowUnits(scales, 2 * WIDTH, 30.0)), 0.0)
    particles = ParticleSet.from_numpy(now)
    context = dynamics.context(particles)
    acceleration, flow = dynamics.model.rates(context).acceleration, context.resolved
    return acceleration.numpy(), flow


@pytest.mark.mpi(1)
def test_the_projected_stress_comes_closest_to_the_accelerations_of_tracers(comm):
    before, now, after = frames_of_tracers(make_grid(comm, CELLS))
    exact = (after["velocity"] - before["velocity"]) / (2 * STEP)

    def error(acceleration):
        difference = acceleration - exact
        return float(np.linalg.norm(difference - difference.mean(0)) / np.linalg.norm(exact))

    with_stress, _ = modelled(now, "pressure", "stress", "viscosity")
    gradient, flow = modelled(now, "pressure", "stress", "viscosity", form="gradient")
    without, _ = modelled(now, "pressure", "viscosity")
    slopes = flow.grid.slopes(flow.velocity)
    divergence = flow.grid.stress_divergence(WIDTH**2 / 12 * flow.grid.products(slopes, slopes))
    unprojected = without - flow.at_particles(divergence).numpy()
    errors = [error(each) for each in (with_stress, gradient, unprojected, without)]
    assert errors[0] < errors[1] < 0.5 * min(errors[2:]), errors
    assert errors[0] < 0.025, errors
