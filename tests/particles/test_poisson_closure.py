import numpy as np
import pytest
import torch

from eddies.flow import initial_fields
from eddies.flow.interpolation import SplineInterpolation
from eddies.flow.operators import pressure
from eddies.flow.pressure import PressureSolver
from eddies.flow.spectral_grid import SpectralGrid
from eddies.flow.tracers import release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.poisson_closure import PoissonClosure
from eddies.particles.smoothing_kernels import WendlandC2

LENGTH, PER_SIDE, SOUND_SPEED = 2 * np.pi, 16, 10.0
SUPPORT = 1.8 * LENGTH / PER_SIDE


def particles_in_turbulence(comm):
    """Particles with a smooth random velocity, and the exact density deviation p / c^2 at them."""
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 48))
    velocity = initial_fields.random_velocity(grid, 5, 1.0, 1.5)
    spline = SplineInterpolation(grid, "quintic")
    columns = release(grid.decomposition, 3, PER_SIDE, "random")
    modes = np.concatenate([velocity, pressure(grid, velocity)[None]])
    values = spline.at(spline.coefficients(modes), columns["position"])
    particles = ParticleSet.from_numpy({**columns, "velocity": values[:, :3], "density": np.ones(len(values))})
    return particles, values[:, 3] / SOUND_SPEED**2


def closure_on(comm, passes):
    solver = PressureSolver(SlabDecomposition(comm, LENGTH, PER_SIDE), resolved=6)
    return PoissonClosure(solver, WendlandC2(SUPPORT), SOUND_SPEED, passes=passes, dtype=torch.float64)


@pytest.mark.mpi(1)
def test_each_pass_brings_the_density_closer_to_the_exact_pressure(comm):
    particles, exact = particles_in_turbulence(comm)
    errors = []
    for passes in (1, 2, 4):
        deviation = as_numpy(closure_on(comm, passes).apply(particles).density) - 1
        errors.append(np.linalg.norm(deviation - exact) / np.linalg.norm(exact))
    assert errors[0] > 1.5 * errors[1] > 1.5 * errors[2] and errors[2] < 0.15


@pytest.mark.mpi(1, 2, 3)
def test_density_is_the_same_on_any_number_of_ranks(comm):
    from mpi4py import MPI

    def density(communicator):
        particles = particles_in_turbulence(communicator)[0]
        # The closure's slabs are those of a coarser grid.
        slab = SlabDecomposition(communicator, LENGTH, PER_SIDE)
        moved = ParticleSet.from_numpy(migrate(slab, particles.to_numpy()))
        closed = closure_on(communicator, 2).apply(moved)
        order = IdOrder(communicator, as_numpy(closed.id), PER_SIDE**3)
        return order, order.apply(as_numpy(closed.density))

    order, found = density(comm)
    alone = density(MPI.COMM_SELF)[1]
    assert np.allclose(found - 1, alone[order.start : order.stop] - 1, rtol=1e-11, atol=1e-14)


@pytest.mark.mpi(1)
def test_uniform_motion_has_no_pressure(comm):
    particles, _ = particles_in_turbulence(comm)
    moving = ParticleSet(particles.id, particles.position, torch.full_like(particles.velocity, 3.0), particles.density)
    assert np.abs(as_numpy(closure_on(comm, 4).apply(moving).density) - 1).max() < 1e-7


@pytest.mark.mpi(2)
def test_a_particle_beyond_the_ghost_planes_is_refused_on_all_ranks(comm):
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    particles = ParticleSet.from_numpy(migrate(slab, particles_in_turbulence(comm)[0].to_numpy()))
    far = particles.position.clone()
    if comm.rank == 1:
        far[0, 2] = slab.upper + 1.5 * slab.spacing
    with pytest.raises(HaloError, match="shorten the time step"):
        closure_on(comm, 1).apply(ParticleSet(particles.id, far, particles.velocity, particles.density))
