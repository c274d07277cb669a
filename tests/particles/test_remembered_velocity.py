"""Memory of a resolved velocity: forecasts of a known flow, and what few particles tell over several frames."""

import numpy as np
import pytest
import torch

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_set import ParticleSet
from eddies.particles.remembered_velocity import RememberedVelocity
from eddies.particles.resolved_velocity import ResolvedVelocity

VISCOSITY, WAVENUMBER = 0.05, 2


def abc_flow(position, time, drift):
    """ABC flow of wavenumber 2 in a frame that moves: an exact solution, which decays as exp(-nu k^2 t)."""
    x, y, z = ((position - drift * time) * WAVENUMBER).T
    velocity = np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)], 1)
    return np.exp(-VISCOSITY * WAVENUMBER**2 * time) * velocity + drift


def particles_of(comm, slab, count, time, seed, drift):
    """Random particles of this rank in the flow; each moment has its own, as when tracks are short."""
    position = np.random.default_rng([seed, round(1000 * time)]).uniform(0, 2 * np.pi, (count, 3))
    rows = np.flatnonzero((position[:, 2] >= slab.start * slab.spacing) & (position[:, 2] < slab.stop * slab.spacing))
    return ParticleSet.from_numpy({"id": rows, "position": position[rows],
                                   "velocity": abc_flow(position[rows], time, drift)})


def exact(grid, time, drift):
    """The modes of the flow."""
    slab = grid.decomposition
    axis = np.arange(slab.planes) * slab.spacing
    z, y, x = np.meshgrid(axis[slab.start:slab.stop], axis, axis, indexing="ij")
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    field = abc_flow(points, time, drift).T.reshape(3, *z.shape)
    return grid.to_modes(torch.from_numpy(np.ascontiguousarray(field)))


def remembered(comm, planes=16, resolved=5, memory=16.0):
    grid = FourierGrid(SlabDecomposition(comm, 2 * np.pi, planes), resolved, 1)
    return RememberedVelocity(ResolvedVelocity(grid, 1e-3, weight=1.0), VISCOSITY, torch.ones_like(grid.shell), memory)


@pytest.mark.mpi(1)
def test_a_forecast_is_the_exact_solution(comm):
    flow, still = remembered(comm), np.zeros(3)
    start, grid = exact(flow.solver.grid, 0.0, still), flow.solver.grid
    found = flow.forecast(start, 0.5)
    # Runge-Kutta steps of u' k dt = 0.5; |u|^2 is 3 at the start.
    assert float(grid.multiplicity.mul((found - exact(grid, 0.5, still)).abs().square().sum(0)).sum()) < 1e-8


@pytest.mark.mpi(1)
def test_the_viscous_decay_of_a_forecast_is_exact_at_any_viscosity(comm):
    """In explicit steps round-off would grow a thousandfold a substep: nu k^2 dt is up to 15."""
    flow = remembered(comm)
    flow.viscosity = 2.0
    start = exact(flow.solver.grid, 0.0, np.zeros(3))
    expected = np.exp(-flow.viscosity * WAVENUMBER**2 * 0.5) * start
    assert torch.allclose(flow.forecast(start, 0.5), expected, rtol=0, atol=1e-13)


@pytest.mark.mpi(1)
def test_without_data_the_variance_of_the_prior_stays_that_of_the_flow(comm):
    flow = remembered(comm)
    first = flow.solver.equations.penalty
    assert torch.allclose(flow._next_penalty(torch.full_like(first, 0.7)), first, rtol=1e-12)


@pytest.mark.mpi(1)
def test_few_particles_tell_more_over_several_frames(comm):
    """30 particles, new ones in each frame, for 90 modes: one frame cannot determine them, ten can."""
    drift = np.array([0.3, -0.2, 0.1])
    flow = remembered(comm)
    grid, errors = flow.solver.grid, []
    for frame in range(12):
        time = 0.05 * frame
        modes = flow.of(particles_of(comm, grid.decomposition, 30, time, 1, drift), time)
        missed = grid.multiplicity * (modes - exact(grid, time, drift)).abs().square().sum(0)
        errors.append(np.sqrt(comm.allreduce(float(missed.sum())) / 3))
    assert errors[0] > 0.3
    assert errors[-1] < 0.5 * errors[0]


@pytest.mark.mpi(1)
def test_flows_follow_their_forecasts_five_times_longer_than_the_estimate_counts(comm):
    """With k dt = 1 and a memory C = 2 beta is exp(-u'/4), and gamma is beta^(1/5)."""
    flow, still = remembered(comm, memory=2.0), np.zeros(3)
    slab = flow.solver.grid.decomposition
    first = flow.of(particles_of(comm, slab, 500, 0.0, 2, still), 0.0)
    flow.of(particles_of(comm, slab, 500, 0.5, 2, still), 0.5)
    nothing = torch.zeros_like(first)
    forgotten = -flow.deviation(first, nothing)                     # beta F(u)
    followed = flow.deviation(nothing, nothing) + forgotten         # gamma F(u)
    speed = np.sqrt(float((flow.solver.grid.multiplicity * first.abs().square().sum(0)).sum()) / 3)
    # Errors of the estimate have other wavenumbers, with a few per cent of its energy.
    assert float(followed.abs().norm() / forgotten.abs().norm()) == pytest.approx(np.exp(0.8 * speed / 4), rel=5e-3)
