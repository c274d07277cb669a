from dataclasses import replace

import numpy as np
import pytest
import torch
from clouds import DensityReader, along, assert_close, by_id, distributed, dynamics_of, model, of_terms
from mpi4py import MPI

from eddies.flow import initial_fields
from eddies.flow.operators import pressure
from eddies.flow.tracers import release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder, migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.reference_scales import ReferenceScales
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import WendlandC2
from eddies.particles.surroundings import Surroundings
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH, PER_SIDE, SOUND_SPEED = 2 * np.pi, 16, 10.0
SUPPORT = 1.8 * LENGTH / PER_SIDE
SCALES = ReferenceScales(length=0.5, spacing=0.4, velocity=1.0, density_mean=1.0, density=0.01, acceleration=2.0,
                         density_rate=0.05, sound_speed=SOUND_SPEED, viscosity=0.02)
FLOW = FlowUnits(SCALES, 0.8, 20.0)


def particles_in_turbulence(comm):
    """Particles with a smooth random velocity, and the exact density deviation p / c^2 at them."""
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 48))
    velocity = initial_fields.random_velocity(grid, 5, 1.0, 1.5)
    spline = SplineInterpolation(grid, "quintic")
    columns = release(grid.decomposition, 3, PER_SIDE, "random")
    modes = np.concatenate([velocity, pressure(grid, velocity)[None]])
    values = spline.at(spline.coefficients(modes), columns["position"])
    return ParticleSet.from_numpy({**columns, "velocity": values[:, :3]}), values[:, 3] / SOUND_SPEED**2


def in_slabs_of_the_particles(comm):
    """The slabs of a grid of a cell for each particle, and its own ones of such particles."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    return slab, ParticleSet.from_numpy(migrate(slab, particles_in_turbulence(comm)[0].to_numpy()))


def dynamics(slab, passes, *words):
    """Of the resolved terms, with a density, in double precision."""
    terms = model({word: {} for word in words or ("pressure", "stress", "damping", "relaxation")}, FLOW).terms.values()
    found = dynamics_of(slab, of_terms(*terms, DensityReader(), flow=FLOW), 0.0, fixed_ranks=True)
    found.resolution = ResolvedVelocity(FourierGrid(slab, 6), WendlandC2(SUPPORT), passes=passes, dtype=torch.float64)
    found.surroundings = Surroundings(slab, LENGTH, 0.0, SUPPORT, 0.0)
    return found


@pytest.mark.mpi(1)
def test_each_pass_brings_the_density_closer_to_the_exact_pressure(comm):
    particles, exact = particles_in_turbulence(comm)
    errors = []
    for passes in (1, 2, 4):
        rates = dynamics(SlabDecomposition(comm, LENGTH, PER_SIDE), passes, "pressure").rates(particles)
        errors.append(np.linalg.norm(as_numpy(rates.density) - 1 - exact) / np.linalg.norm(exact))
    assert errors[0] > 1.5 * errors[1] > 1.5 * errors[2] and errors[2] < 0.15


@pytest.mark.mpi(1, 2, 3)
def test_density_and_energies_are_the_same_on_any_number_of_ranks(comm):
    def density(communicator):
        slab, particles = in_slabs_of_the_particles(communicator)
        found = dynamics(slab, 2)
        with torch.no_grad():
            rates = found.rates(particles)
            bands = found.resolution.band_energies(particles)
        order = IdOrder(communicator, as_numpy(particles.id), PER_SIDE**3)
        return order, order.apply(as_numpy(rates.density)), bands

    order, found, bands = density(comm)
    _, alone, bands_alone = density(MPI.COMM_SELF)
    assert np.allclose(found - 1, alone[order.start : order.stop] - 1, rtol=1e-11, atol=1e-14)
    assert torch.allclose(bands, bands_alone, rtol=1e-11) and len(bands) == 3


@pytest.mark.mpi(1)
def test_uniform_motion_has_no_pressure(comm):
    particles, _ = particles_in_turbulence(comm)
    moving = replace(particles, velocity=torch.full_like(particles.velocity, 3.0))
    rates = dynamics(SlabDecomposition(comm, LENGTH, PER_SIDE), 4).rates(moving)
    assert (rates.density - 1).abs().max() < 1e-12 and rates.acceleration.abs().max() < 1e-12


@pytest.mark.mpi(2)
def test_a_particle_beyond_the_ghost_planes_is_refused_on_all_ranks(comm):
    slab, particles = in_slabs_of_the_particles(comm)
    far = particles.position.clone()
    if comm.rank == 1:
        far[0, 2] = slab.upper + 1.5 * slab.spacing
    with pytest.raises(HaloError, match="shorten the time step"):
        dynamics(slab, 1).rates(replace(particles, position=far))


@pytest.mark.mpi(1, 2, 3)
def test_gradient_of_density_and_force_against_central_differences(comm):
    """Through averages, ghosts, transforms and splines, in positions, velocities and parameters."""
    slab, particles = in_slabs_of_the_particles(comm)
    found = dynamics(slab, 3)
    random = np.random.default_rng(comm.rank)
    weights = [torch.from_numpy(random.standard_normal(shape)) for shape in ((len(particles),), (len(particles), 3))]
    changes = torch.from_numpy(random.standard_normal((2, len(particles), 3)))

    def share(position, velocity):
        rates = found.rates(replace(particles, position=position, velocity=velocity))
        # Density deviates by a hundredth or so: weighted, both count.
        return 100 * (weights[0] * rates.density).sum() + (weights[1] * rates.acceleration).sum()

    columns = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]
    share(*columns).backward()
    for number, change in enumerate(changes):
        step = [change * (row == number) for row in range(2)]
        difference = global_sum(comm, float(along(share, [column.detach() for column in columns], step, 1e-6)))
        expected = global_sum(comm, float((columns[number].grad * change).sum()))
        # Particles that enter or leave a support add kinks of second order in the step.
        assert difference == pytest.approx(expected, rel=1e-5)
    for parameter in found.model.parameters():
        gradient = global_sum(comm, parameter.grad.numpy())
        values = []
        with torch.no_grad():
            for sign in (1, -2, 1):
                parameter += sign * 1e-3
                values.append(global_sum(comm, float(share(particles.position, particles.velocity))))
        # The force is linear in its parameters.
        assert (values[0] - values[1]) / 2e-3 == pytest.approx(gradient.sum(), rel=1e-8)


@pytest.mark.mpi(1, 2, 3)
def test_gradient_of_the_band_energies_against_central_differences(comm):
    slab, particles = in_slabs_of_the_particles(comm)
    resolution, random = dynamics(slab, 2).resolution, np.random.default_rng(comm.rank)
    weights = torch.tensor([1.3, -0.7, 2.0], dtype=torch.float64)
    change = torch.from_numpy(random.standard_normal((len(particles), 3)))

    def share(velocity):  # of which each rank has the same, so that they have it `size` times
        return (weights * resolution.band_energies(replace(particles, velocity=velocity))).sum() / comm.size

    velocity = particles.velocity.clone().requires_grad_()
    share(velocity).backward()
    with torch.no_grad():
        ends = [comm.size * float(share(velocity + sign * change)) for sign in (1, -1)]
    found = float(global_sum(comm, float((velocity.grad * change).sum())))
    assert found == pytest.approx((ends[0] - ends[1]) / 2, rel=1e-9)  # the energy is quadratic


@pytest.mark.mpi(1)
def test_energies_by_bands_of_known_waves(comm):
    """sin y in x (shell 1, band 0) and 2 cos 3z in y (shell 3, band 1): 1/4 and 1, but for what the average takes."""
    side = 32
    axis = torch.arange(side, dtype=torch.float64) * (LENGTH / side)
    position = torch.cartesian_prod(axis, axis, axis)
    velocity = torch.stack([torch.sin(position[:, 1]), 2 * torch.cos(3 * position[:, 2]), 0 * position[:, 0]], dim=1)
    particles = ParticleSet(torch.arange(len(position)), position, velocity)
    resolution = ResolvedVelocity.on_slabs(SlabDecomposition(comm, LENGTH, side), torch.float64)
    bands = resolution.band_energies(particles)
    assert bands[:2].tolist() == pytest.approx([0.25, 1.0], rel=1e-3) and bands[2:].abs().max() < 1e-12


def particles_around_a_void(comm):
    """The slabs, and particles with random velocities in seven octants of the box."""
    random = np.random.default_rng(8)
    position = random.uniform(0, LENGTH, (700, 3))
    position = position[(position > LENGTH / 2).any(1)]
    velocity = random.standard_normal(position.shape)
    slab, particles = distributed(comm, torch.from_numpy(position), torch.from_numpy(velocity), planes=PER_SIDE)
    return slab, particles, len(position)


@pytest.mark.mpi(1, 2, 3)
def test_a_void_looks_the_same_from_every_frame_of_reference(comm):
    """Density and force, and so their derivatives by a uniform velocity are zero."""
    slab, particles, _ = particles_around_a_void(comm)
    found = dynamics(slab, 2)
    velocity = particles.velocity.requires_grad_()
    still = found.rates(replace(particles, velocity=velocity))
    carried = found.rates(replace(particles, velocity=velocity.detach() + torch.tensor([5.0, -3.0, 10.0])))
    for name in ("density", "acceleration"):
        # Squares of 10 are rounded, but not as parts of what is solved for.
        assert torch.allclose(getattr(carried, name), getattr(still, name).detach(), rtol=0, atol=1e-12)
    weights = torch.from_numpy(np.random.default_rng(comm.rank).standard_normal(particles.position.shape))
    ((weights * still.acceleration).sum() + 100 * (weights[:, 0] * still.density).sum()).backward()
    by_frame = global_sum(comm, velocity.grad.sum(0).numpy())
    by_each = float(global_sum(comm, float(velocity.grad.abs().sum())))
    assert np.abs(by_frame).max() < 1e-13 * by_each


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("words", [("pressure",), ("pressure", "stress", "damping", "relaxation")])
def test_the_force_keeps_the_momentum_of_the_particles(comm, words):
    """The grid's own has a mean, as the particles do not sample it evenly."""
    slab, particles, count = particles_around_a_void(comm)
    force = by_id(comm, particles, dynamics(slab, 2, *words).rates(particles).acceleration, count)
    sizes = force.norm(dim=1).sum()
    assert sizes > 1 and force.sum(0).abs().max() < 1e-13 * sizes


@pytest.mark.mpi(1, 2)
def test_the_resolved_velocity_is_solenoidal_and_what_it_misses_is_the_rest(comm):
    slab, particles, count = particles_around_a_void(comm)
    found = dynamics(slab, 3)
    flow = found.context(particles).resolved
    assert flow.grid.divergence(flow.velocity).abs().max() < 1e-13 * flow.velocity.abs().max() * 6
    assert torch.equal(flow.velocity, flow.grid.within(flow.velocity))
    mean = by_id(comm, particles, particles.velocity, count).mean(0)
    resolved = flow.at_particles(flow.velocity)
    assert_close(flow.missing(), particles.velocity - mean - resolved, 1e-12)
    alone = found.resolution.alone(particles)
    assert torch.allclose(alone.velocity, flow.velocity, rtol=0, atol=1e-12 * float(flow.velocity.abs().max()))
