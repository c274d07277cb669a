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
    assert relative(found, exact) < 0.16
    assert np.abs(found.sum(0)).max() < 1e-9 * np.abs(found).sum()  # momentum is kept
    none = equations()
    none.terms["filtered-equations"].stress.data.zero_()
    assert relative(accelerations(comm, none), exact) > 1.8 * relative(found, exact)


@pytest.mark.mpi(1)
def test_sweeps_find_the_pressure_from_nothing(comm):
    """Repeated, from a density without any: what far away particles have a part in takes the most sweeps."""
    rest, errors = torch.ones(len(POSITION), dtype=torch.float64), {}
    exact = at(FIELD.force(NU), POSITION)
    for sweeps in (1, 8, 64, 400):
        errors[sweeps] = relative(accelerations(comm, equations(sweeps=sweeps), density=rest), exact)
    assert errors[1] > errors[8] > errors[64] > errors[400] and errors[400] < 0.2


@pytest.mark.mpi(1)
def test_the_density_goes_where_the_pressure_is(comm):
    lagrangian, c = equations(density=2.0, sweeps=400), UNITS.scales.sound_speed
    slab, particles = particles_on(comm, torch.ones(len(POSITION), dtype=torch.float64))
    rate = dynamics_of(slab, lagrangian).rates(particles).density_rate.detach()
    speed = float(VELOCITY.square().mean().sqrt())
    exact = 2.0 * 2 * speed / UNITS.scales.filter_width * PRESSURE[particles.id] / c**2
    assert relative(rate.numpy(), exact.numpy()) < 0.2


@pytest.mark.mpi(1)
def test_a_divergence_is_taken_out_and_what_neighbours_do_not_tell_relaxes(comm):
    """A potential flow is slowed down by the pressure alone, noise by the relaxation alone."""
    x = torch.from_numpy(POSITION)
    velocity = 1e-3 * torch.stack([torch.sin(x[:, 0]), torch.sin(2 * x[:, 1]), torch.zeros_like(x[:, 2])], 1)
    rest = torch.ones(len(x), dtype=torch.float64)
    rate = 2 * float((velocity - velocity.mean(0)).square().mean().sqrt()) / UNITS.scales.filter_width
    still = replace(UNITS, scales=replace(UNITS.scales, viscosity=0.0))
    terms = {"filtered-equations": dict(sweeps=400, solenoidal=1e3, relaxation=0.0)}
    slab, particles = alone(x, velocity, rest)
    found = dynamics_of(slab, model(terms, still)).rates(particles).acceleration.detach()
    own = velocity[particles.id] - velocity.mean(0)
    assert relative(found.numpy(), -1e3 * rate * own.numpy()) < 0.15
    noise = torch.from_numpy(np.random.default_rng(5).normal(0, 1e-3, (len(x), 3)))
    terms = {"filtered-equations": dict(sweeps=1, solenoidal=0.0, relaxation=1e3)}
    slab, particles = alone(x, noise, rest)
    found = dynamics_of(slab, model(terms, still)).rates(particles).acceleration.detach()
    assert float((found * particles.velocity).sum()) < 0


@pytest.mark.mpi(1)
def test_it_is_linear_in_what_is_learned(comm):
    slab, particles = particles_on(comm)
    lagrangian = equations()
    context = dynamics_of(slab, lagrangian).context(particles)
    lagrangian.require_linear(context)
    assert set(lagrangian.linear_rates(context)) == {"filtered-equations"}


@pytest.mark.mpi(2, 3)
def test_the_number_of_ranks_does_not_matter(comm):
    whole = accelerations(comm, equations())
    # To the rounding of double precision by the condition of a neighbourhood, 1e5.
    assert relative(whole, accelerations(MPI.COMM_SELF, equations())) < 1e-9


@pytest.mark.mpi(1)
def test_particles_without_neighbours_go_on(comm):
    x = torch.tensor([[1.0, 1.0, 1.0], [4.0, 4.0, 4.0]], dtype=torch.float64)
    velocity = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    slab, particles = alone(x, velocity, torch.ones(2, dtype=torch.float64))
    rates = dynamics_of(slab, equations()).rates(particles)
    assert torch.isfinite(rates.acceleration).all() and torch.isfinite(rates.density_rate).all()
