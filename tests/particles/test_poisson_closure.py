from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.flow import initial_fields
from eddies.spectral.interpolation import SplineInterpolation
from eddies.flow.operators import pressure
from eddies.flow.pressure import PressureSolver
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.flow.tracers import release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
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


def closure_on(comm, passes, factors=None):
    solver = PressureSolver(SlabDecomposition(comm, LENGTH, PER_SIDE), resolved=6)
    return PoissonClosure(solver, WendlandC2(SUPPORT), SOUND_SPEED, passes=passes, dtype=torch.float64, factors=factors)


@pytest.mark.mpi(1)
def test_each_pass_brings_the_density_closer_to_the_exact_pressure(comm):
    particles, exact = particles_in_turbulence(comm)
    errors = []
    for passes in (1, 2, 4):
        deviation = as_numpy(closure_on(comm, passes).apply(particles)[0].density) - 1
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
        closed, _ = closure_on(communicator, 2).apply(moved)
        order = IdOrder(communicator, as_numpy(closed.id), PER_SIDE**3)
        return order, order.apply(as_numpy(closed.density))

    order, found = density(comm)
    alone = density(MPI.COMM_SELF)[1]
    assert np.allclose(found - 1, alone[order.start : order.stop] - 1, rtol=1e-11, atol=1e-14)


@pytest.mark.mpi(1)
def test_uniform_motion_has_no_pressure(comm):
    particles, _ = particles_in_turbulence(comm)
    moving = ParticleSet(particles.id, particles.position, torch.full_like(particles.velocity, 3.0), particles.density)
    assert np.abs(as_numpy(closure_on(comm, 4).apply(moving)[0].density) - 1).max() < 1e-7


@pytest.mark.mpi(2)
def test_a_particle_beyond_the_ghost_planes_is_refused_on_all_ranks(comm):
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    particles = ParticleSet.from_numpy(migrate(slab, particles_in_turbulence(comm)[0].to_numpy()))
    far = particles.position.clone()
    if comm.rank == 1:
        far[0, 2] = slab.upper + 1.5 * slab.spacing
    with pytest.raises(HaloError, match="shorten the time step"):
        closure_on(comm, 1).apply(ParticleSet(particles.id, far, particles.velocity, particles.density))


@pytest.mark.mpi(1, 2, 3)
def test_gradient_of_density_and_force_against_central_differences(comm):
    """Through averages, ghosts, transforms and splines, in positions and velocities."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    particles = ParticleSet.from_numpy(migrate(slab, particles_in_turbulence(comm)[0].to_numpy()))
    factors = torch.tensor([0.02, 0.2, 0.5, 0.7], dtype=torch.float64, requires_grad=True)
    dynamics = ParticleDynamics(slab, LENGTH, [], 0.0, closure_on(comm, 3, lambda: factors), fixed_ranks=True)
    random = np.random.default_rng(comm.rank)
    weights = [torch.from_numpy(random.standard_normal(shape)) for shape in ((len(particles),), (len(particles), 3))]
    changes = torch.from_numpy(random.standard_normal((2, len(particles), 3)))

    def share(position, velocity):
        rates = dynamics.rates(replace(particles, position=position, velocity=velocity))
        # Density deviates by a hundredth or so: weighted, both count.
        return 100 * (weights[0] * rates["closure_density"]).sum() + (weights[1] * rates["velocity"]).sum()

    columns = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]
    share(*columns).backward()
    by_factors = global_sum(comm, factors.grad.numpy())
    for number, change in enumerate(changes):
        step = 1e-6
        with torch.no_grad():
            ends = [share(*(column + sign * change * (row == number) for row, column in enumerate(columns)))
                    for sign in (step, -step)]
        found = global_sum(comm, float(ends[0] - ends[1]) / (2 * step))
        expected = global_sum(comm, float((columns[number].grad * change).sum()))
        # Particles that enter or leave a support add kinks of second order in the step.
        assert found == pytest.approx(expected, rel=1e-5)
    for number in range(len(factors)):
        with torch.no_grad():
            values = []
            for sign in (1, -2, 1):
                factors[number] += sign * 1e-3
                values.append(global_sum(comm, float(share(particles.position, particles.velocity))))
        # The force is linear in its factors.
        assert (values[0] - values[1]) / 2e-3 == pytest.approx(by_factors[number], rel=1e-8)


def particles_around_a_void(comm):
    """The slabs, and particles with random velocities in seven octants of the box."""
    random = np.random.default_rng(8)
    position = random.uniform(0, LENGTH, (700, 3))
    position = position[(position > LENGTH / 2).any(1)]
    columns = {"id": np.arange(len(position)), "position": position, "velocity": random.standard_normal(position.shape),
               "density": np.ones(len(position))}
    own = {name: column[columns["id"] % comm.size == comm.rank] for name, column in columns.items()}
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    return slab, ParticleSet.from_numpy(migrate(slab, own))


@pytest.mark.mpi(1, 2, 3)
def test_a_void_looks_the_same_from_every_frame_of_reference(comm):
    """Density and force, and so their derivatives by a uniform velocity are zero."""
    slab, particles = particles_around_a_void(comm)
    factors = torch.tensor([0.02, 0.2, 0.5, 0.7], dtype=torch.float64)
    dynamics = ParticleDynamics(slab, LENGTH, [], 0.0, closure_on(comm, 2, lambda: factors), fixed_ranks=True)
    velocity = particles.velocity.requires_grad_()
    still = dynamics.rates(replace(particles, velocity=velocity))
    carried = dynamics.rates(replace(particles, velocity=velocity.detach() + torch.tensor([5.0, -3.0, 10.0])))
    for name in ("closure_density", "velocity"):
        # Squares of 10 are rounded, but not as parts of what is solved for.
        assert torch.allclose(carried[name], still[name].detach(), rtol=0, atol=1e-12)
    weights = torch.from_numpy(np.random.default_rng(comm.rank).standard_normal(particles.position.shape))
    ((weights * still["velocity"]).sum() + 100 * (weights[:, 0] * still["closure_density"]).sum()).backward()
    by_frame = global_sum(comm, velocity.grad.sum(0).numpy())
    by_each = float(global_sum(comm, float(velocity.grad.abs().sum())))
    assert np.abs(by_frame).max() < 1e-13 * by_each


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("factors", [(0.0, 0.0, 0.0, 0.0), (0.02, 0.2, 0.5, 0.7)])
def test_the_force_keeps_the_momentum_of_the_particles(comm, factors):
    """The grid's own has a mean, as the particles do not sample it evenly."""
    slab, particles = particles_around_a_void(comm)
    closure = closure_on(comm, 2, lambda: torch.tensor(factors, dtype=torch.float64))
    force = ParticleDynamics(slab, LENGTH, [], 0.0, closure, fixed_ranks=True).rates(particles)["velocity"]
    total, sizes = global_sum(comm, force.sum(0).numpy()), float(global_sum(comm, float(force.norm(dim=1).sum())))
    assert sizes > 1 and np.abs(total).max() < 1e-13 * sizes


@pytest.mark.mpi(1, 2)
def test_force_at_fixed_particles_is_that_of_the_dynamics(comm):
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    particles = ParticleSet.from_numpy(migrate(slab, particles_in_turbulence(comm)[0].to_numpy()))
    closure = closure_on(comm, 2, lambda: torch.tensor([0.02, 0.2, 0.5, 0.7], dtype=torch.float64))
    rates = ParticleDynamics(slab, LENGTH, [], 0.0, closure, fixed_ranks=True).rates(particles)
    closed, force = closure.apply(particles)
    assert torch.allclose(force.at(slice(None)), rates["velocity"], rtol=0, atol=1e-12)
    assert torch.allclose(closed.density, rates["closure_density"], rtol=0, atol=1e-14)
