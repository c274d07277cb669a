"""The modes that least squares find against known modes, their gradients, and predictions for later solves."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity, dissipation_range
from tests.particles.configurations import (
    LENGTH, along, assert_close, density_reader, distributed, dynamics_of, model, of_terms, positions,
)
from tests.validation import filtered_fields

SIDE, PLANES = 12, 22
RESOLVED = ("pressure", "stress", "viscosity", "damping", "relaxation")


def units(side=SIDE, width=2.0, **scales):
    """Flow with side^3 particles and a filter `width` times as wide as their spacing."""
    scales = ReferenceScales(**dict(
        filter_width=width * LENGTH / side, spacing=LENGTH / side, velocity=1.0, density_mean=1.0, density=0.01,
        acceleration=2.0, density_rate=0.05, sound_speed=10.0, viscosity=0.02) | scales)
    return FlowUnits(scales, 0.8, 20.0)


def resolution_on(slab, side=SIDE, tolerance=1e-6):
    resolution = ResolvedVelocity.on_slabs(slab, units(side).scales)
    resolution.tolerance = resolution.tolerance_predicted = resolution.tolerance_adjoint = tolerance
    return resolution


def filtered_modes(highest, width):
    """Filtered modes of a random velocity with energies k^(-5/3)."""
    k = np.sqrt(np.maximum(filtered_fields.SQUARED, 1))
    modes = filtered_fields.random_velocity(7, highest) * k ** (-11 / 6)
    return filtered_fields.Filtered(modes, width).velocity


def in_known_flow(comm, side=SIDE, highest=4, planes=PLANES):
    """The slabs, side^3 particles in a filtered velocity of modes up to `highest`, and these modes."""
    modes, position = filtered_modes(highest, 2 * LENGTH / side), positions(count=side**3)
    velocity = torch.from_numpy(filtered_fields.at(modes, position.numpy()))
    return *distributed(comm, position, velocity, planes=planes), modes


def lagrangian(side=SIDE):
    """Terms of a resolved velocity, and a term that reads the density."""
    terms = model({word: {} for word in RESOLVED}, units(side)).terms.values()
    return of_terms(*terms, density_reader(), flow=units(side))


def relative_error(flow, modes):
    """Error of the resolved velocity at random points of this rank's slab, over all ranks."""
    slab, points = flow.grid.decomposition, positions(count=900, seed=9)
    points = points[(points[:, 2] >= slab.lower) & (points[:, 2] < slab.upper)]
    exact = torch.from_numpy(filtered_fields.at(modes, points.numpy()))
    error = flow.grid.at(flow.velocity, flow.grid.points(points)) - exact
    squares = global_sum(slab.comm, np.array([float(each.square().sum()) for each in (error, exact)]))
    return (squares[0] / squares[1]) ** 0.5


@pytest.mark.mpi(1, 3)
def test_known_modes_are_found(comm):
    slab, particles, modes = in_known_flow(comm)
    flow = resolution_on(slab).of(particles)
    assert flow.grid.resolved == 9 and flow.converged
    # Regularisation removes a part: there are 2 x 3050 unknowns for 3 x 1728 data.
    assert relative_error(flow, modes) < 0.03
    left, square = (float(global_sum(comm, float(rows.square().sum())))
                    for rows in (flow.missing(), particles.velocity))
    assert left < 1e-4 * square


@pytest.mark.mpi(1)
def test_modes_beyond_the_nyquist_wavenumber_are_found(comm):
    """8^3 particles on a lattice cannot resolve waves above 4; random ones in a solenoidal velocity can."""
    slab, particles, modes = in_known_flow(comm, 8, highest=5, planes=32)
    flow = resolution_on(slab, 8).of(particles)
    assert flow.grid.resolved == 6
    assert relative_error(flow, modes) < 0.06


@pytest.mark.mpi(1, 2)
def test_particles_in_one_period_determine_all(comm):
    """The flow has two periods along z, and particles are in the upper one alone."""
    modes = filtered_modes(4, 2 * LENGTH / SIDE) * (filtered_fields.WAVE[2] % 2 == 0)
    position = positions(count=SIDE**3 // 2)
    position[:, 2] = (position[:, 2] + LENGTH) / 2
    slab, particles = distributed(comm, position, torch.from_numpy(filtered_fields.at(modes, position.numpy())),
                                  planes=PLANES)
    scales = units().scales
    # As many particles a volume as in `test_known_modes_are_found`. Without the period half of the box is guessed.
    assert relative_error(ResolvedVelocity.on_slabs(slab, scales, periods=(1, 1, 2)).of(particles), modes) < 0.03
    assert relative_error(ResolvedVelocity.on_slabs(slab, scales).of(particles), modes) > 0.1


def test_the_dissipation_range_dissipates_all_energy():
    """The dissipation 2 nu int k^2 E dk of E = 1.5 eps^(2/3) k^(-5/3) f(k eta) is eps."""
    x = np.linspace(0, 30, 300001)
    dissipated = 2 * 1.5 * np.trapezoid(x ** (1 / 3) * dissipation_range(x), x)
    assert dissipated == pytest.approx(1, abs=0.005)  # the constants are rounded


@pytest.mark.mpi(3)
def test_a_rank_without_particles_takes_part_there_and_back(comm):
    position = positions(count=300) * torch.tensor([1.0, 1.0, 0.3], dtype=torch.float64)
    slab, particles = distributed(comm, position, torch.randn(300, 3, dtype=torch.float64), planes=PLANES)
    assert comm.rank != 2 or len(particles) == 0
    dynamics = dynamics_of(slab, lagrangian(), iterations=3)
    columns = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]
    dynamics.rates(replace(particles, position=columns[0], velocity=columns[1])).acceleration.square().sum().backward()
    assert all(torch.isfinite(column.grad).all() for column in columns)


@pytest.mark.mpi(2)
def test_all_ranks_refuse_a_particle_beyond_the_ghost_planes(comm):
    slab, particles, _ = in_known_flow(comm)
    if comm.rank == 1:
        particles.position[0, 2] = slab.upper + 1.5 * slab.spacing
    with pytest.raises(HaloError, match="shorten the time step"):
        dynamics_of(slab, lagrangian()).rates(particles)


@pytest.mark.mpi(2)
def test_gradient_of_density_and_force_against_central_differences(comm):
    """Through the solve, transforms and splines, by positions, velocities and parameters."""
    slab, particles, _ = in_known_flow(comm, 6, planes=12)
    dynamics = dynamics_of(slab, lagrangian(side=6), tolerance=1e-11)
    dynamics.resolution.most_iterations = 1000
    random = np.random.default_rng(comm.rank)
    weights = [torch.from_numpy(random.standard_normal(shape)) for shape in ((len(particles),), (len(particles), 3))]
    changes = torch.from_numpy(random.standard_normal((2, len(particles), 3)))

    def share(position, velocity):
        rates = dynamics.rates(replace(particles, position=position, velocity=velocity))
        # The deviation of the density is about a hundredth of the force.
        return 100 * (weights[0] * rates.density).sum() + (weights[1] * rates.acceleration).sum()

    columns = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]
    share(*columns).backward()
    for number, change in enumerate(changes):
        step = [change * (row == number) for row in range(2)]
        with torch.no_grad():
            slope = global_sum(comm, float(along(share, [column.detach() for column in columns], step, 1e-5)))
        expected = global_sum(comm, float((columns[number].grad * change).sum()))
        # The third derivatives of splines jump, and the solves' residual of 1e-11 is divided by the step.
        assert slope == pytest.approx(expected, rel=1e-5)
    for parameter in dynamics.model.parameters():
        gradient = global_sum(comm, parameter.grad.numpy())
        values = []
        with torch.no_grad():
            for sign in (1, -2, 1):
                parameter += sign * 1e-3
                values.append(global_sum(comm, float(share(particles.position, particles.velocity))))
        # The force is linear in its parameters.
        assert (values[0] - values[1]) / 2e-3 == pytest.approx(gradient.sum(), rel=1e-5)


@pytest.mark.mpi(1)
def test_energies_of_known_waves_by_bands(comm):
    """sin y in x (shell 1, band 0) and 2 cos 3z in y (shell 3, band 1) on a lattice: 1/4 and 1."""
    side = 16
    axis = torch.arange(side, dtype=torch.float64) * (LENGTH / side)
    position = torch.cartesian_prod(axis, axis, axis)
    velocity = torch.stack([torch.sin(position[:, 1]), 2 * torch.cos(3 * position[:, 2]), 0 * position[:, 0]], dim=1)
    particles = ParticleSet(torch.arange(len(position)), position, velocity)
    resolution = resolution_on(SlabDecomposition(comm, LENGTH, 28), side, 1e-9)
    velocity.requires_grad_()
    bands = resolution.band_energies(replace(particles, velocity=velocity))
    assert bands[:2].tolist() == pytest.approx([0.25, 1.0], rel=3e-3) and bands[2:].abs().max() < 1e-3
    # The energy is quadratic: its derivative along the velocity is twice the energy.
    for band in (0, 1):
        (gradient,) = torch.autograd.grad(bands[band], velocity, retain_graph=True)
        assert float((gradient * velocity).detach().sum()) == pytest.approx(2 * float(bands[band].detach()), rel=1e-6)


@pytest.mark.mpi(2)
def test_the_resolved_velocity_is_solenoidal_and_what_it_misses_is_the_rest(comm):
    """The particles have random velocities and fill seven octants of the box."""
    random = np.random.default_rng(8)
    position = random.uniform(0, LENGTH, (700, 3))
    position = position[(position > LENGTH / 2).any(1)]
    velocity = torch.from_numpy(random.standard_normal(position.shape))
    slab, particles = distributed(comm, torch.from_numpy(position), velocity, planes=PLANES)
    flow = resolution_on(slab).of(particles)
    # The rounding of each iteration adds up.
    assert flow.grid.divergence(flow.velocity).abs().max() < 1e-11 * flow.velocity.abs().max()
    assert torch.equal(flow.velocity, flow.grid.within(flow.velocity))
    expected = particles.velocity - flow.at_particles(flow.modes)
    assert_close(flow.missing(), expected, 1e-12)


@pytest.mark.mpi(1)
def test_the_highest_wavenumber_is_that_of_particles_filter_or_turbulence(comm):
    slab = SlabDecomposition(comm, LENGTH, 56)
    assert ResolvedVelocity.on_slabs(slab, units(32).scales).grid.resolved == 24
    wide = ResolvedVelocity.on_slabs(slab, units(32, width=6.0).scales).grid.resolved
    assert np.exp(-(wide * 6 * LENGTH / 32) ** 2 / 24) >= 0.02 > np.exp(-((wide + 1) * 6 * LENGTH / 32) ** 2 / 24)
    assert ResolvedVelocity.on_slabs(slab, units(32, kolmogorov_length=0.1).scales).grid.resolved == 10


# ---- predictions


@pytest.mark.mpi(2)
def test_predictions_are_exact_for_a_linear_rate(comm):
    slab, particles, _ = in_known_flow(comm)
    resolution = resolution_on(slab)
    flow = replace(resolution.of(particles), mean=torch.zeros(3))
    assert resolution.predicted(0.3, 0.0) is None

    def at(time):  # du/dt = (1 + 2t) w, w = u(0)
        return (1 + time + time**2) * flow.velocity

    for time in (0.1, 0.25):
        now = replace(flow, velocity=at(time))
        rate = (1 + 2 * time) * flow.velocity
        resolution.remember(time, now, rate + flow.grid.stress_divergence(now.products))  # P[force - div(uu)] = rate
    for time in (0.4, 0.2):
        assert_close(resolution.predicted(time, 0.0), at(time), 1e-12)
    # Modes that turn by a large part of their phase within the step are removed, slow ones are kept.
    exact = at(0.4)
    reduced = resolution.predicted(0.4, 3.0)
    for shells, least, most in ((flow.grid.shell == 1, 0.4, 0.8), (flow.grid.shell > 4, 0.0, 1e-3)):
        square, expected = (float(global_sum(comm, float(modes[:, shells].abs().square().sum())))
                            for modes in (reduced, exact))
        assert least <= (square / expected) ** 0.5 <= most


@pytest.mark.mpi(2)
def test_a_prediction_moves_with_the_mean_velocity(comm):
    """The modes of particles in uniform motion with a wave on it are later those of the moved wave."""
    slab, particles, modes = in_known_flow(comm)
    resolution, mean, time = resolution_on(slab), torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64), 0.7
    flow = resolution.of(replace(particles, velocity=particles.velocity + mean))
    assert_close(flow.mean, mean, 1e-3)  # to the tolerance of the solve
    resolution.remember(0.0, flow, flow.grid.stress_divergence(flow.products))  # no other change
    velocity = torch.from_numpy(filtered_fields.at(modes, positions(count=SIDE**3).numpy())) + mean
    slab, later = distributed(comm, (positions(count=SIDE**3) + time * mean) % LENGTH, velocity, planes=PLANES)
    predicted = resolution.predicted(time, 0.0)
    expected = resolution_on(slab).of(later).modes
    # The splines' error depends on the places of particles in their cells.
    assert (predicted - expected).abs().max() < 5e-3 * expected.abs().max()


@pytest.mark.mpi(2)
def test_a_solve_starts_from_the_prediction_and_continues_bitwise(comm):
    slab, particles, _ = in_known_flow(comm)
    dynamics = dynamics_of(slab, lagrangian(), tolerance=1e-5)
    with torch.no_grad():
        first = dynamics.rates_after(0.0, particles)
        dynamics.rates_after(0.0, particles)
        assert dynamics.resolution.solves[0][0] > 10 and dynamics.resolution.solves[1][0] == 0
        dynamics.rates_after(0.05, replace(particles, velocity=particles.velocity + 0.05 * first.acceleration))
        other = dynamics_of(slab, lagrangian(), tolerance=1e-5)
        other.load_state_dict(dynamics.state_dict())
        assert other.resolution.speed == dynamics.resolution.speed > 0
        one, two = (which.rates_after(0.1, particles).acceleration for which in (dynamics, other))
        assert torch.equal(one, two) and other.resolution.solves[-1] == dynamics.resolution.solves[-1]
        # A moment without a time, and a new run, do not use predictions.
        assert torch.equal(dynamics.rates(particles).acceleration, first.acceleration)
        dynamics.begin()
        assert dynamics.time == dynamics.evaluations == 0
        assert torch.equal(dynamics.rates(particles, time=0.3).acceleration, first.acceleration)


@pytest.mark.mpi(1)
def test_a_prediction_worse_than_zero_is_dropped_and_a_solve_without_convergence_reported(comm):
    slab, particles, _ = in_known_flow(comm)
    resolution = resolution_on(slab)
    flow = resolution.of(particles)
    resolution.remember(0.0, replace(flow, velocity=-5 * flow.velocity), None)
    assert_close(resolution.of(particles, time=0.0).velocity, flow.velocity, 1e-12)
    resolution.most_iterations = 2
    flow = resolution.of(particles)
    assert not flow.converged and flow.iterations == 2 and flow.residual > resolution.tolerance
    assert not resolution.of(replace(particles, velocity=particles.velocity * torch.nan)).converged
