"""The modes that least squares find against modes that are known, and what they mean for forces."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity, dissipation_range
from tests.particles.configurations import (
    CONFIGURATIONS, LENGTH, DensityReader, along, assert_close, by_id, distributed, dynamics_of, model, of_terms,
    positions,
)
from tests.validation import filtered_fields

SIDE, PLANES = 12, 22
RESOLVED = ("pressure", "stress", "viscosity", "damping", "relaxation")


def units(side, width=2.0):
    """Of a flow with side^3 particles and a filter `width` times as wide as their spacing."""
    scales = ReferenceScales(filter_width=width * LENGTH / side, spacing=LENGTH / side, velocity=1.0, density_mean=1.0,
                             density=0.01, acceleration=2.0, density_rate=0.05, sound_speed=10.0, viscosity=0.02)
    return FlowUnits(scales, 0.8, 20.0)


def resolution_on(slab, side=SIDE, tolerance=1e-6):
    found = ResolvedVelocity.on_slabs(slab, units(side))
    found.tolerance = found.tolerance_foreseen = found.tolerance_adjoint = tolerance
    return found


def filtered_modes(highest, width):
    """Modes of a random velocity with energies k^(-5/3), filtered."""
    k = np.sqrt(np.maximum(filtered_fields.SQUARED, 1))
    modes = filtered_fields.random_velocity(7, highest) * k ** (-11 / 6)
    return filtered_fields.Filtered(modes, width).velocity


def in_known_flow(comm, side=SIDE, highest=4, planes=PLANES, kind="even"):
    """The slabs, side^3 particles in a filtered velocity of modes up to `highest`, and these modes."""
    modes = filtered_modes(highest, 2 * LENGTH / side)
    position = positions(kind, side**3)
    velocity = torch.from_numpy(filtered_fields.at(modes, position.numpy()))
    return *distributed(comm, position, velocity, planes=planes), modes


def relative_error(flow, modes, above=0.0):
    """Of the resolved modes with |k| > `above`, over all ranks."""
    slab = flow.grid.decomposition
    n, k = slab.planes, np.arange(-5, 6)
    padded = np.zeros((3, n, n, n), complex)
    padded[np.ix_(range(3), k, k, k)] = modes[np.ix_(range(3), k, k, k)]
    fields = np.fft.ifftn(padded, axes=(1, 2, 3)).real * n**3
    exact = flow.grid.to_modes(torch.from_numpy(np.ascontiguousarray(fields[:, slab.start : slab.stop])))

    def size(field):
        energy = flow.grid.multiplicity * field.abs().square().sum(0)
        return float(global_sum(slab.comm, float(energy[flow.grid.shell > above].sum())))

    return (size(flow.velocity - exact) / size(exact)) ** 0.5


@pytest.mark.mpi(1, 2, 3)
def test_known_modes_are_found(comm):
    slab, particles, modes = in_known_flow(comm)
    flow = resolution_on(slab).of(particles)
    assert flow.grid.resolved == 9 and flow.converged
    # Regularisation takes a part of them: there are more unknowns, 2 for each of 3050 waves, than data, 3 x 1728.
    assert relative_error(flow, modes) < 0.03
    left, all_of_it = (float(global_sum(comm, float(rows.square().sum())))
                       for rows in (flow.missing(), particles.velocity))
    assert left < 1e-4 * all_of_it


@pytest.mark.mpi(1)
def test_modes_beyond_the_nyquist_wavenumber_are_found(comm):
    """8^3 particles cannot tell waves above 4 on a lattice; at random, with a solenoidal velocity, they can."""
    _, particles, modes = in_known_flow(comm, 8, highest=5, planes=32)
    flow = resolution_on(SlabDecomposition(comm, LENGTH, 32), 8).of(particles)
    assert flow.grid.resolved == 6
    assert relative_error(flow, modes) < 0.06 and relative_error(flow, modes, above=4.0) < 0.6


def test_spectra_end_so_that_all_energy_is_dissipated():
    """With E = 1.5 eps^(2/3) k^(-5/3) f(k eta) the dissipation 2 nu int k^2 E dk is eps: the constants of f are known
    answers, those with which it is."""
    x = np.linspace(0, 30, 300001)
    dissipated = 2 * 1.5 * np.trapezoid(x ** (1 / 3) * dissipation_range(x), x)
    assert dissipated == pytest.approx(1, abs=0.005)  # they are rounded


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", [*CONFIGURATIONS, "empty octant"])
def test_no_arrangement_of_particles_disturbs_a_solve(comm, kind):
    """Clusters, voids, all in one place: what is minimised is never more than without any mode; where there are
    particles everywhere, or but for an octant, the solve ends soon."""
    position = positions("even" if kind == "empty octant" else kind, 512)
    if kind == "empty octant":
        position = position[(position > LENGTH / 2).any(1)]
    velocity = torch.from_numpy(filtered_fields.at(filtered_modes(4, LENGTH / 4), position.numpy()))
    slab, particles = distributed(comm, position, velocity, planes=PLANES)
    found = ResolvedVelocity.on_slabs(slab, units(8))
    found.most_iterations = 150
    flow = found.of(particles)
    penalty = (found.equations.penalty * flow.grid.multiplicity * flow.velocity.abs().square().sum(0)).sum()
    assert flow.missing().square().sum() + penalty <= flow.relative_velocity.square().sum()
    # Where most particles are in a few places a solve takes hundreds of iterations, and says that it did not converge.
    assert flow.converged == (kind not in ("cluster across a corner", "void", "uneven"))


@pytest.mark.mpi(1)
def test_of_a_flow_at_rest_and_of_uniform_motion_at_any_speed_nothing_is_left(comm):
    slab, particles, _ = in_known_flow(comm)
    for speed in (0.0, 3.0, 1e4):
        moving = replace(particles, velocity=torch.full_like(particles.velocity, speed))
        found = dynamics_of(slab, lagrangian(), tolerance=1e-10)
        rates = found.rates(moving)
        # Of the mean of 1e4 that is taken away round-off stays.
        assert (rates.density - 1).abs().max() < 1e-12 + 1e-12 * speed
        assert rates.acceleration.abs().max() <= 1e-11 * speed
        if speed == 0:
            assert found.resolution.of(moving).iterations == 0


def lagrangian(*words, side=SIDE):
    """Terms of a resolved velocity, and one that reads the density."""
    terms = model({word: {} for word in words or RESOLVED}, units(side)).terms.values()
    return of_terms(*terms, DensityReader(), flow=units(side))


@pytest.mark.mpi(2, 3)
def test_the_same_on_any_number_of_ranks(comm):
    """At a fixed number of iterations to rounding, otherwise to what the solves leave."""
    for iterations, tolerance, allowed in ((12, None, 1e-12), (None, 1e-5, 1e-4)):
        found = []
        for over in (comm, MPI.COMM_SELF):
            slab, particles, _ = in_known_flow(over)
            rates = dynamics_of(slab, lagrangian(), iterations=iterations, tolerance=tolerance).rates(particles)
            found.append(by_id(over, particles, torch.cat([rates.acceleration, rates.density[:, None]], 1), SIDE**3))
        assert ((found[0] - found[1]).abs().max(0).values < allowed * found[1].abs().max(0).values).all()


@pytest.mark.mpi(3)
def test_a_rank_without_particles_takes_part_there_and_back(comm):
    position = positions(count=300) * torch.tensor([1.0, 1.0, 0.3], dtype=torch.float64)
    slab, particles = distributed(comm, position, torch.randn(300, 3, dtype=torch.float64), planes=PLANES)
    assert comm.rank != 2 or len(particles) == 0
    found = dynamics_of(slab, lagrangian(), fixed_ranks=True)
    columns = [column.clone().requires_grad_() for column in (particles.position, particles.velocity)]
    found.rates(replace(particles, position=columns[0], velocity=columns[1])).acceleration.square().sum().backward()
    assert all(torch.isfinite(column.grad).all() for column in columns)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("value", [torch.nan, torch.inf])
def test_a_position_that_is_not_finite_is_refused_on_all_ranks(comm, value):
    slab, particles, _ = in_known_flow(comm)
    lost = particles.position.clone()
    if comm.rank == comm.size - 1:
        lost[0, 1] = value
    with pytest.raises(HaloError, match="not finite"):
        resolution_on(slab).of(replace(particles, position=lost))


@pytest.mark.mpi(2)
def test_a_particle_beyond_the_ghost_planes_is_refused_on_all_ranks(comm):
    slab, particles, _ = in_known_flow(comm)
    far = particles.position.clone()
    if comm.rank == 1:
        far[0, 2] = slab.upper + 1.5 * slab.spacing
    with pytest.raises(HaloError, match="shorten the time step"):
        dynamics_of(slab, lagrangian(), fixed_ranks=True).rates(replace(particles, position=far))


@pytest.mark.mpi(2)
def test_gradient_of_density_and_force_against_central_differences(comm):
    """Through the solve, transforms and splines, in positions, velocities and parameters."""
    slab, particles, _ = in_known_flow(comm, 6, planes=12)
    found = dynamics_of(slab, lagrangian(side=6), tolerance=1e-11, fixed_ranks=True)
    found.resolution.most_iterations = 1000
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
        with torch.no_grad():
            slope = global_sum(comm, float(along(share, [column.detach() for column in columns], step, 1e-5)))
        expected = global_sum(comm, float((columns[number].grad * change).sum()))
        # The splines' third derivatives jump, the solves end at 1e-11 of what is multiplied by 1e5.
        assert slope == pytest.approx(expected, rel=1e-5)
    for parameter in found.model.parameters():
        gradient = global_sum(comm, parameter.grad.numpy())
        values = []
        with torch.no_grad():
            for sign in (1, -2, 1):
                parameter += sign * 1e-3
                values.append(global_sum(comm, float(share(particles.position, particles.velocity))))
        # The force is linear in its parameters.
        assert (values[0] - values[1]) / 2e-3 == pytest.approx(gradient.sum(), rel=1e-5)


@pytest.mark.mpi(2)
def test_gradient_of_the_band_energies_against_central_differences(comm):
    slab, particles, _ = in_known_flow(comm, 6, planes=12)
    resolution, random = resolution_on(slab, 6, 1e-12), np.random.default_rng(comm.rank)
    resolution.most_iterations = 2000
    weights = torch.tensor([1.3, -0.7], dtype=torch.float64)
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
    """sin y in x (shell 1, band 0) and 2 cos 3z in y (shell 3, band 1): 1/4 and 1; on a lattice."""
    side = 16
    axis = torch.arange(side, dtype=torch.float64) * (LENGTH / side)
    position = torch.cartesian_prod(axis, axis, axis)
    velocity = torch.stack([torch.sin(position[:, 1]), 2 * torch.cos(3 * position[:, 2]), 0 * position[:, 0]], dim=1)
    particles = ParticleSet(torch.arange(len(position)), position, velocity)
    bands = resolution_on(SlabDecomposition(comm, LENGTH, 28), side).band_energies(particles)
    # What regularisation takes: the expected noise over the number of particles, a thousandth at most.
    assert bands[:2].tolist() == pytest.approx([0.25, 1.0], rel=3e-3) and bands[2:].abs().max() < 1e-3


def particles_around_a_void(comm):
    """The slabs, and particles with random velocities in seven octants of the box."""
    random = np.random.default_rng(8)
    position = random.uniform(0, LENGTH, (700, 3))
    position = position[(position > LENGTH / 2).any(1)]
    velocity = random.standard_normal(position.shape)
    slab, particles = distributed(comm, torch.from_numpy(position), torch.from_numpy(velocity), planes=PLANES)
    return slab, particles, len(position)


@pytest.mark.mpi(1, 2, 3)
def test_a_void_looks_the_same_from_every_frame_of_reference(comm):
    """Density and force, and so their derivatives by a uniform velocity are zero."""
    slab, particles, _ = particles_around_a_void(comm)
    found = dynamics_of(slab, lagrangian(), iterations=20, fixed_ranks=True)
    velocity = particles.velocity.requires_grad_()
    still = found.rates(replace(particles, velocity=velocity))
    carried = found.rates(replace(particles, velocity=velocity.detach() + torch.tensor([5.0, -3.0, 10.0])))
    for name in ("density", "acceleration"):
        # Squares of 10 are rounded, but not as parts of what is solved for.
        size = float(getattr(still, name).abs().max())
        assert torch.allclose(getattr(carried, name), getattr(still, name).detach(), rtol=0, atol=1e-11 * size)
    weights = torch.from_numpy(np.random.default_rng(comm.rank).standard_normal(particles.position.shape))
    ((weights * still.acceleration).sum() + 100 * (weights[:, 0] * still.density).sum()).backward()
    by_frame = global_sum(comm, velocity.grad.sum(0).numpy())
    by_each = float(global_sum(comm, float(velocity.grad.abs().sum())))
    assert np.abs(by_frame).max() < 1e-13 * by_each


@pytest.mark.mpi(2)
@pytest.mark.parametrize("words", [("pressure",), RESOLVED])
def test_the_force_keeps_the_momentum_of_the_particles(comm, words):
    """The grid's own has a mean, as the particles do not sample it evenly."""
    slab, particles, count = particles_around_a_void(comm)
    force = by_id(comm, particles, dynamics_of(slab, lagrangian(*words)).rates(particles).acceleration, count)
    sizes = force.norm(dim=1).sum()
    assert sizes > 1 and force.sum(0).abs().max() < 1e-12 * sizes


@pytest.mark.mpi(1, 2)
def test_the_resolved_velocity_is_solenoidal_and_what_it_misses_is_the_rest(comm):
    slab, particles, count = particles_around_a_void(comm)
    flow = resolution_on(slab).of(particles)
    # The rounding of each iteration adds up.
    assert flow.grid.divergence(flow.velocity).abs().max() < 1e-11 * flow.velocity.abs().max()
    assert torch.equal(flow.velocity, flow.grid.within(flow.velocity))
    mean = by_id(comm, particles, particles.velocity, count).mean(0)
    assert_close(flow.missing(), particles.velocity - mean - flow.at_particles(flow.velocity), 1e-12)


@pytest.mark.mpi(1)
def test_the_wavenumbers_end_where_the_filter_or_turbulence_ends(comm):
    slab = SlabDecomposition(comm, LENGTH, 56)
    assert ResolvedVelocity.on_slabs(slab, units(32)).grid.resolved == 24
    wide = ResolvedVelocity.on_slabs(slab, units(32, width=6.0)).grid.resolved
    assert np.exp(-(wide * 6 * LENGTH / 32) ** 2 / 24) >= 0.02 > np.exp(-((wide + 1) * 6 * LENGTH / 32) ** 2 / 24)
    viscous = replace(units(32), scales=replace(units(32).scales, kolmogorov_length=0.1))
    assert ResolvedVelocity.on_slabs(slab, viscous).grid.resolved == 10


# ---- from one evaluation to the next


@pytest.mark.mpi(1, 2)
def test_what_is_foreseen_of_a_rate_that_changes_linearly_is_exact(comm):
    slab, particles, _ = in_known_flow(comm)
    found = resolution_on(slab)
    flow, zero = found.of(particles), np.zeros(3)
    assert found.foreseen(0.3, zero, 0.0) is None

    def at(time):  # u(t) with du/dt = (1 + 2t) w, w = u(0)
        return (1 + time + time**2) * flow.velocity

    def force(time):  # such that P[force - div(uu)] is that rate
        now = replace(flow, velocity=at(time))
        return now, (1 + 2 * time) * flow.velocity + flow.grid.stress_divergence(now.products)

    for time in (0.1, 0.25):
        found.remember(time, *force(time))
    assert_close(found.foreseen(0.4, zero, 0.0), at(0.4), 1e-12)
    assert_close(found.foreseen(0.2, zero, 0.0), at(0.2), 1e-12)


@pytest.mark.mpi(1)
def test_what_is_foreseen_comes_from_the_nearer_evaluation(comm):
    slab, particles, _ = in_known_flow(comm)
    found, zero = resolution_on(slab), np.zeros(3)
    flow = found.of(particles)
    for time in (0.0, 1.0):  # du/dt = t^2 w: what the parabola through both rates misses grows with the way
        now = replace(flow, velocity=(1 + time**3 / 3) * flow.velocity)
        found.remember(time, now, time**2 * flow.velocity + flow.grid.stress_divergence(now.products))
    for time, way, side in ((0.2, 0.2, -1), (0.8, 0.2, 1), (0.5, 0.5, 1)):  # the later one where both are as near
        missed = side * (way**2 / 2 - way**3 / 3)
        assert_close(found.foreseen(time, zero, 0.0), (1 + time**3 / 3 - missed) * flow.velocity, 1e-12)


@pytest.mark.mpi(1, 2)
def test_a_forecast_is_as_large_as_it_deserves(comm):
    """Modes that a velocity U carries along, u exp(-ik.Ut), normally distributed with 0.8 a component: in the mean over
    many U no forecast of a shell is worse than none, one of slow modes is good, and without their worth those of fast
    ones are worse than none."""
    slab, particles, _ = in_known_flow(comm)
    flow, zero, random = resolution_on(slab).of(particles), np.zeros(3), np.random.default_rng(4)
    shell = torch.round(flow.grid.shell).long()
    missed, size = {speed: torch.zeros(10, dtype=torch.float64) for speed in (0.0, 0.8)}, torch.zeros(10)
    for _ in range(12):
        turn = sum(k * float(u) for k, u in zip(flow.grid.wavevector, 0.8 * random.normal(size=3)))

        def at(time):
            return flow.velocity * torch.exp(-1j * turn * time)

        found = resolution_on(slab)
        for time in (-0.2, 0.0):
            now = replace(flow, velocity=at(time))
            found.remember(time, now, -1j * turn * at(time) + flow.grid.stress_divergence(now.products))
        for speed, shells in missed.items():
            shells += by_shells(flow.grid, shell, found.foreseen(0.2, zero, speed) - at(0.2))
        size = size + by_shells(flow.grid, shell, at(0.2))
    raw, worth = ((missed[speed] / size)[1:] for speed in (0.0, 0.8))
    assert worth.max() < 1 < raw[-1] and worth[1] < 0.05
    assert (worth[5:] < raw[5:]).all()


def by_shells(grid, shell, modes):
    """Energy of modes by shells 0 to 9, over all ranks."""
    energy = grid.multiplicity * modes.abs().square().sum(0)
    inside = shell < 10
    sums = torch.zeros(10, dtype=torch.float64).index_add(0, shell[inside], energy[inside])
    return torch.from_numpy(global_sum(grid.decomposition.comm, sums.numpy()))


@pytest.mark.mpi(1, 2)
def test_what_is_foreseen_moves_along_with_the_mean(comm):
    """Particles of a uniform motion with a wave on it: their modes after a time are the old ones, moved."""
    slab, particles, modes = in_known_flow(comm)
    found, mean, time = resolution_on(slab), torch.tensor([3.0, -1.0, 2.0], dtype=torch.float64), 0.7
    flow = found.of(particles)
    found.remember(0.0, flow, flow.grid.stress_divergence(flow.products))  # nothing else happens to it
    moved = positions(count=SIDE**3) + time * mean
    velocity = torch.from_numpy(filtered_fields.at(modes, positions(count=SIDE**3).numpy()))
    slab, later = distributed(comm, moved % LENGTH, velocity + mean, planes=PLANES)
    expected = resolution_on(slab).of(later)
    foreseen = found.foreseen(time, (velocity + mean).mean(0).numpy(), 0.0)
    foreseen = foreseen * torch.exp(1j * time * sum(k * float(v) for k, v in zip(
        flow.grid.wavevector, velocity.mean(0))))  # the modes themselves do not move with the wave's own mean
    # To the splines' error, which depends on where particles are in their cells.
    assert (foreseen - expected.velocity).abs().max() < 5e-3 * expected.velocity.abs().max()


@pytest.mark.mpi(1, 2)
def test_a_solve_starts_from_what_is_foreseen_and_goes_on_bit_for_bit(comm):
    slab, particles, _ = in_known_flow(comm)
    found = dynamics_of(slab, lagrangian(), tolerance=1e-5)
    first = found.rates_after(0.0, particles)
    assert found.resolution.solves[0][0] > 10
    found.rates_after(0.0, particles)
    assert found.resolution.solves[1][0] == 0  # known already
    found.rates_after(0.05, replace(particles, velocity=particles.velocity + 0.05 * first.acceleration))
    other = dynamics_of(slab, lagrangian(), tolerance=1e-5)
    other.load_state_dict(found.state_dict())
    assert other.resolution.speed == found.resolution.speed > 0
    one, two = (which.rates_after(0.1, particles).acceleration for which in (found, other))
    assert torch.equal(one, two) and other.resolution.solves[-1] == found.resolution.solves[-1]


@pytest.mark.mpi(1)
def test_a_start_that_is_worse_than_none_is_dropped(comm):
    slab, particles, _ = in_known_flow(comm)
    found = resolution_on(slab)
    flow = found.of(particles)
    found.remember(0.0, replace(flow, velocity=-5 * flow.velocity), None)
    assert_close(found.of(particles, time=0.0).velocity, flow.velocity, 1e-12)


@pytest.mark.mpi(1)
def test_a_solve_that_does_not_converge_says_so(comm):
    slab, particles, _ = in_known_flow(comm)
    found = resolution_on(slab)
    found.most_iterations = 2
    flow = found.of(particles)
    assert not flow.converged and flow.iterations == 2 and flow.residual > found.tolerance
    lost = replace(particles, velocity=particles.velocity * torch.nan)
    assert not found.of(lost).converged
