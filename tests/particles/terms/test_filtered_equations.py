"""The filtered equations by kriging against the exact ones, from the unfiltered velocity by plain transforms."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from tests.particles.configurations import alone, by_id, distributed, dynamics_of, model, relative
from tests.particles.test_kriging import FLOW, POSITION, SPACING
from tests.validation.filtered_fields import Filtered, at, random_velocity

FIELD = Filtered(random_velocity(4), 2 * SPACING)
NU = 0.05
UNITS = replace(FLOW, scales=replace(FLOW.scales, viscosity=NU, sound_speed=20.0))
VELOCITY = torch.from_numpy(at(FIELD.velocity, POSITION))
DENSITY = torch.from_numpy(1 + at(FIELD.pressure[None], POSITION)[:, 0] / UNITS.scales.sound_speed**2)
FORCE = at(FIELD.force(NU), POSITION)
REST = torch.ones(len(POSITION), dtype=torch.float64)


def equations(units=UNITS, **settings):
    return model({"filtered-equations": settings}, units)


def accelerations(comm, lagrangian):
    slab, particles = distributed(comm, torch.from_numpy(POSITION), VELOCITY, DENSITY)
    found = dynamics_of(slab, lagrangian).rates(particles)
    return by_id(comm, particles, found.acceleration, len(POSITION)).numpy()


@pytest.mark.mpi(2)
def test_the_force_is_that_of_the_filtered_equations(comm):
    """The error is that of 60 random neighbours. Without its stress the force is another. Ranks do not matter."""
    force = accelerations(comm, equations())
    assert relative(force, FORCE) < 0.17
    none = equations()
    none.terms["filtered-equations"].stress.data.zero_()
    assert relative(accelerations(comm, none), FORCE) > 1.5 * relative(force, FORCE)
    # To rounding times the condition number of a neighbourhood, 1e5.
    assert comm.size == 1 or relative(force, accelerations(MPI.COMM_SELF, equations())) < 1e-9


def settled(slab, particles, lagrangian, times):
    """Particles and rates after the density has followed the pressure several times, at fixed positions."""
    dynamics, rate = dynamics_of(slab, lagrangian), lagrangian.terms["filtered-equations"].settings.density
    velocity = particles.velocity - particles.velocity.mean(0)
    rate = rate * 2 * float(velocity.square().mean().sqrt()) / UNITS.scales.filter_width
    with torch.no_grad():
        for _ in range(times):
            particles = replace(particles, density=particles.density + dynamics.rates(particles).density_rate / rate)
        return particles, dynamics.rates(particles)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("sweeps, enough", [(8, 8), (32, 1)])
def test_sweeps_find_the_pressure_from_nothing_and_stay_there(comm, sweeps, enough):
    """Twenty evaluations more change nothing: no part of the pressure grows."""
    slab, particles = alone(torch.from_numpy(POSITION), VELOCITY, REST)
    order = particles.id.numpy()
    for times in (enough, enough + 20):
        found, rates = settled(slab, particles, equations(sweeps=sweeps), times)
        assert relative(found.density.numpy() - 1, DENSITY.numpy()[order] - 1) < 0.2
        assert relative(rates.acceleration.numpy(), FORCE[order]) < 0.19
    first = dynamics_of(slab, equations(sweeps=sweeps)).rates(particles).acceleration.detach()
    assert sweeps == 32 or relative(first.numpy(), FORCE[order]) > 0.2


@pytest.mark.mpi(1)
def test_a_divergence_is_removed_and_noise_relaxes(comm):
    """The pressure alone slows a weak potential flow, and the relaxation alone slows noise."""
    x, still = torch.from_numpy(POSITION), replace(UNITS, scales=replace(UNITS.scales, viscosity=0.0))
    velocity = 1e-3 * torch.stack([torch.sin(x[:, 0]), torch.sin(2 * x[:, 1]), torch.zeros_like(x[:, 2])], 1)
    own = velocity - velocity.mean(0)
    rate = 2 * float(own.square().mean().sqrt()) / UNITS.scales.filter_width
    slab, particles = alone(x, velocity, REST)
    _, rates = settled(slab, particles, equations(still, sweeps=16, solenoidal=1e3, relaxation=0.0), 10)
    assert relative(rates.acceleration.numpy(), -1e3 * rate * own[particles.id].numpy()) < 0.15
    noise = torch.from_numpy(np.random.default_rng(5).normal(0, 1e-3, (len(x), 3)))
    slab, particles = alone(x, noise, REST)
    lagrangian = equations(still, sweeps=1, solenoidal=0.0, relaxation=1e3)
    found = dynamics_of(slab, lagrangian).rates(particles).acceleration.detach()
    loss = -float((found * particles.velocity).sum() / particles.velocity.square().sum())
    # Neighbours cannot predict noise: all of it relaxes, and more, since their estimate is noise too.
    assert loss > 1e3 * 2 * float(noise.square().mean().sqrt()) / UNITS.scales.filter_width


@pytest.mark.mpi(1)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32], ids=str)
def test_the_term_is_linear_in_its_parameter(comm, dtype):
    """Large contributions cancel, and single precision still differs only by rounding."""
    slab, particles = distributed(comm, torch.from_numpy(POSITION), VELOCITY, DENSITY)
    lagrangian = equations().to(dtype)
    context = dynamics_of(slab, lagrangian, dtype=dtype).context(particles)
    lagrangian.require_linear(context)
    assert set(lagrangian.linear_rates(context)) == {"filtered-equations"}
