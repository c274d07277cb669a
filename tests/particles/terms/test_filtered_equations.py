"""The filtered equations by neighbours against the exact ones, made of the unfiltered velocity by plain transforms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from tests.particles.configurations import alone, by_id, distributed, dynamics_of, model
from tests.particles.test_kriging import FLOW, POSITION, SPACING, relative
from tests.validation.filtered_fields import Filtered, at, random_velocity

FIELD = Filtered(random_velocity(4), 2 * SPACING)
NU = 0.05
UNITS = replace(FLOW, scales=replace(FLOW.scales, viscosity=NU, sound_speed=20.0))
VELOCITY = torch.from_numpy(at(FIELD.velocity, POSITION))
PRESSURE = torch.from_numpy(at(FIELD.pressure[None], POSITION)[:, 0])


def equations(**settings):
    return model({"filtered-equations": settings}, UNITS)


def particles_on(comm, density=None, velocity=VELOCITY):
    density = 1 + PRESSURE / UNITS.scales.sound_speed**2 if density is None else density
    return distributed(comm, torch.from_numpy(POSITION), velocity, density)


def accelerations(comm, lagrangian, **options):
    slab, particles = particles_on(comm, **options)
    found = dynamics_of(slab, lagrangian).rates(particles)
    return by_id(comm, particles, found.acceleration, len(POSITION)).numpy()


@pytest.mark.mpi(1, 2, 3)
def test_the_force_is_that_of_the_filtered_equations(comm):
    """Within what 60 neighbours at random tell; without its stress it is another, and so without pressure."""
    exact = at(FIELD.force(NU), POSITION)
    found = accelerations(comm, equations())
    assert relative(found, exact) < 0.17
    assert np.abs(found.sum(0)).max() < 1e-9 * np.abs(found).sum()  # momentum is kept
    none = equations()
    none.terms["filtered-equations"].stress.data.zero_()
    assert relative(accelerations(comm, none), exact) > 1.5 * relative(found, exact)


def settled(slab, particles, lagrangian, times):
    """The rates when the density has followed the pressure so many times, while particles stay where they are."""
    dynamics, rate = dynamics_of(slab, lagrangian), lagrangian.terms["filtered-equations"].settings.density
    velocity = particles.velocity - particles.velocity.mean(0)
    rate = rate * 2 * float(velocity.square().mean().sqrt()) / UNITS.scales.filter_width
    with torch.no_grad():
        for _ in range(times):
            particles = replace(particles, density=particles.density + dynamics.rates(particles).density_rate / rate)
        return particles, dynamics.rates(particles)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("sweeps, enough", [(1, 256), (8, 8), (32, 1)])
def test_sweeps_find_the_pressure_from_nothing_and_stay_there(comm, sweeps, enough):
    """A hundred evaluations more change nothing: no part of the pressure grows."""
    rest, exact = torch.ones(len(POSITION), dtype=torch.float64), PRESSURE / UNITS.scales.sound_speed**2
    slab, particles = alone(torch.from_numpy(POSITION), VELOCITY, rest)
    for times in (enough, enough + 100):
        found, rates = settled(slab, particles, equations(sweeps=sweeps), times)
        assert relative(found.density.numpy() - 1, exact[found.id].numpy()) < 0.2
        assert relative(rates.acceleration.numpy(), at(FIELD.force(NU), POSITION)[found.id.numpy()]) < 0.19
    first = dynamics_of(slab, equations(sweeps=sweeps)).rates(particles).acceleration.detach()
    assert sweeps == 32 or relative(first.numpy(), at(FIELD.force(NU), POSITION)[particles.id.numpy()]) > 0.2


@pytest.mark.mpi(1)
def test_a_divergence_is_taken_out_and_what_neighbours_do_not_tell_relaxes(comm):
    """A weak potential flow is slowed down by the pressure alone, noise by the relaxation alone."""
    x = torch.from_numpy(POSITION)
    velocity = 1e-3 * torch.stack([torch.sin(x[:, 0]), torch.sin(2 * x[:, 1]), torch.zeros_like(x[:, 2])], 1)
    rest = torch.ones(len(x), dtype=torch.float64)
    own = velocity - velocity.mean(0)
    rate = 2 * float(own.square().mean().sqrt()) / UNITS.scales.filter_width
    still = replace(UNITS, scales=replace(UNITS.scales, viscosity=0.0))
    slab, particles = alone(x, velocity, rest)
    terms = {"filtered-equations": dict(sweeps=16, solenoidal=1e3, relaxation=0.0)}
    _, rates = settled(slab, particles, model(terms, still), 10)
    assert relative(rates.acceleration.numpy(), -1e3 * rate * own[particles.id].numpy()) < 0.15
    noise = torch.from_numpy(np.random.default_rng(5).normal(0, 1e-3, (len(x), 3)))
    slab, particles = alone(x, noise, rest)
    terms = {"filtered-equations": dict(sweeps=1, solenoidal=0.0, relaxation=1e3)}
    found = dynamics_of(slab, model(terms, still)).rates(particles).acceleration.detach()
    speed = float(noise.square().mean().sqrt())
    loss = -float((found * particles.velocity).sum() / particles.velocity.square().sum())
    # Of noise the neighbours tell nothing: all of it relaxes, and more, as they tell what is not there.
    assert loss > 1e3 * 2 * speed / UNITS.scales.filter_width


@pytest.mark.mpi(1)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_it_is_linear_in_what_is_learned(comm, dtype):
    """In the rounding of single precision, too, in which most of what it computes cancels."""
    slab, particles = particles_on(comm)
    lagrangian = equations().to(dtype)
    context = dynamics_of(slab, lagrangian, dtype=dtype).context(particles)
    lagrangian.require_linear(context)
    assert set(lagrangian.linear_rates(context)) == {"filtered-equations"}


@pytest.mark.mpi(2, 3)
def test_the_number_of_ranks_does_not_matter(comm):
    whole = accelerations(comm, equations())
    # To the rounding of double precision by the condition of a neighbourhood, 1e5.
    assert relative(whole, accelerations(MPI.COMM_SELF, equations())) < 1e-9


@pytest.mark.mpi(1)
def test_a_particle_without_neighbours_goes_straight_on(comm):
    """But for the momentum that the others leave over."""
    far = torch.tensor([[3.0, 3.0, 3.0]], dtype=torch.float64)
    x = torch.from_numpy(POSITION)
    others = (x - far).abs().max(1).values > FLOW.cutoff + 0.3  # and more than the skin
    x, velocity = torch.cat([x[others], far]), torch.cat([VELOCITY[others], -far])
    slab, particles = alone(x, velocity, torch.ones(len(x), dtype=torch.float64))
    dynamics, last = dynamics_of(slab, equations()), int(torch.argmax(particles.id))
    assert int(dynamics.context(particles).local.neighbors.offsets.diff()[last]) == 0
    with torch.no_grad():
        rates = dynamics.rates(particles)
    acceleration = rates.acceleration
    assert torch.isfinite(acceleration).all() and rates.density_rate.abs().max() < 1
    assert acceleration[last].norm() < 0.05 * acceleration.norm(dim=1).mean()
