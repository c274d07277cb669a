from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import VelocityVerlet
from eddies.particles.smoothing_kernels import CubicSpline
from tests.particles.configurations import (
    LENGTH, SCALES, alone, by_id, distributed, dynamics_of, model, rates, state, summed_density,
)

SUPPORT, COUNT = 1.5, 200
TRUE = {"sound_speed": 10.0, "alpha": 1.0, "beta": 2.0, "exponent": 7.0}


def sph(spacing=LENGTH / COUNT ** (1 / 3), support=SUPPORT, sound_speed=TRUE["sound_speed"], **values):
    """Continuity and forces; a particle has the mass of a cube of the spacing."""
    flow = FlowUnits(replace(SCALES, spacing=spacing, sound_speed=sound_speed), support, 20.0)
    forces = {name: TRUE[name] for name in ("alpha", "beta", "exponent")} | values
    return model({"continuity": {}, "wcsph": forces}, flow)


def acceleration_alone(position, velocity, density, **values):
    """Acceleration of particles on one rank."""
    return rates(sph(**values), position, velocity, density).acceleration.detach()


def summed(position, spacing=LENGTH / COUNT ** (1 / 3)):
    """Their density by summation."""
    return summed_density(position, CubicSpline(SUPPORT), spacing**3)


MASS = LENGTH**3 / COUNT


def internal_energy(density, c, gamma):
    """e with de/drho = P / rho^2 for rho_0 = 1."""
    return c**2 / gamma * (density ** (gamma - 1) / (gamma - 1) + 1 / density)


@pytest.mark.mpi(1)
def test_a_lattice_at_rest_is_not_pushed(comm):
    points = torch.as_tensor(np.argwhere(np.ones((10, 10, 10))) * (LENGTH / 10))
    density = summed(points, LENGTH / 10)
    # The kernel's integral by the points of the lattice, 57 of them within the support.
    assert density.numpy() == pytest.approx(1, abs=0.02)
    acceleration = acceleration_alone(points, torch.zeros_like(points), density, spacing=LENGTH / 10)
    assert np.ptp(density.numpy()) < 1e-12 and acceleration.abs().max() < 1e-9


@pytest.mark.mpi(1)
def test_pressure_is_the_gradient_of_the_internal_energy(comm):
    """Without viscosity, and with a summed density, a_i = -d/dx_i sum_j e(rho_j): the equations conserve energy."""
    position, velocity, _ = state(COUNT)
    c, gamma = 3.0, 2.5
    moved = position.clone().requires_grad_(True)
    density = summed(moved)
    acceleration = acceleration_alone(position, velocity, density.detach(), sound_speed=c, alpha=0.0, beta=0.0,
                                      exponent=gamma)
    (gradient,) = torch.autograd.grad(internal_energy(density, c, gamma).sum(), moved)
    assert (acceleration + gradient).abs().max() < 1e-11 * acceleration.abs().max()


@pytest.mark.mpi(1, 2, 3)
def test_momentum_is_kept_and_ranks_do_not_matter(comm):
    position, velocity, density = state(COUNT)
    slab, particles = distributed(comm, position, velocity, density)
    acceleration = by_id(comm, particles, dynamics_of(slab, sph()).rates(particles).acceleration, COUNT)
    size = acceleration.abs().max()
    assert acceleration.sum(0).abs().max() < 1e-11 * size
    if comm.rank == 0:
        expected = acceleration_alone(position, velocity, density)
        assert (acceleration - expected).abs().max() < 1e-11 * size


@pytest.mark.mpi(1)
def test_viscosity_acts_on_approaching_pairs_alone_and_takes_energy(comm):
    position, velocity, density = state(COUNT)
    inviscid = acceleration_alone(position, velocity, density, alpha=0.0, beta=0.0)
    viscous = acceleration_alone(position, velocity, density) - inviscid
    assert float((viscous * velocity).sum()) < 0
    # A pair that moves along its line, at a distance r: the closed form of Monaghan's term, or nothing.
    r, c, h = 0.4, TRUE["sound_speed"], SUPPORT / 2
    two = torch.tensor([[1.0, 1, 1], [1.0 + r, 1, 1]], dtype=torch.float64)
    for speed in (-0.5, 0.5):
        away = torch.tensor([[0.0, 0, 0], [speed, 0, 0]], dtype=torch.float64)
        density = torch.tensor([0.9, 1.3], dtype=torch.float64)
        moving, resting = (acceleration_alone(two, each, density) for each in (away, torch.zeros_like(two)))
        mu = min(h * r * speed / (r**2 + 0.01 * h**2), 0)
        expected = (-c * mu + 2 * mu**2) / 1.1
        slope = float(CubicSpline(SUPPORT).derivative(torch.tensor(r, dtype=torch.float64)))
        assert float((moving - resting)[1, 0]) == pytest.approx(-MASS * expected * slope, rel=1e-12, abs=1e-12)


@pytest.mark.mpi(1)
def test_coincident_particles_do_not_push_each_other(comm):
    for distance in (0.0, 1e-300, 1e-16, 1e-8):
        # At the origin, where the smallest of these distances is one.
        position = torch.tensor([[0.0, 1, 1], [distance, 1, 1], [0.5, 1, 1]], dtype=torch.float64)
        density = summed(position)
        acceleration = acceleration_alone(position, torch.zeros_like(position), density)
        assert torch.isfinite(acceleration).all()
        assert (acceleration[0] - acceleration[1]).abs().max() < 1e-6 * acceleration[2].abs().max()


def relaxed_states(terms, side, step, count):
    """States along a WCSPH run with the true parameters, from a jittered lattice with a vigorous large-scale motion."""
    random = np.random.default_rng(2)
    cell = LENGTH / side
    position = torch.as_tensor((np.argwhere(np.ones((side,) * 3)) + random.uniform(0.3, 0.7, (side**3, 3))) * cell)
    velocity = 3 * torch.sin(position[:, [1, 2, 0]]) + torch.as_tensor(random.normal(0, 0.5, position.shape))
    slab, particles = alone(position, velocity, torch.ones(side**3, dtype=torch.float64))
    integrator = VelocityVerlet(dynamics_of(slab, terms, 0.0))
    states = [particles]
    with torch.no_grad():
        for _ in range(count):
            states.append(integrator.step(states[-1], step))
    return slab, states


def in_order(particles):
    """Velocities in order of id: particles are sorted anew where halo and list are built."""
    return particles.velocity[torch.argsort(particles.id)]


@pytest.mark.mpi(1)
def test_parameters_are_recovered_from_trajectories(comm):
    """Trained through steps of the integrator, from values far off, the form finds those that made the trajectories."""
    side, step, together = 5, 0.01, 2
    scales = dict(spacing=LENGTH / side, support=2.3)
    slab, states = relaxed_states(sph(**scales), side, step, 18)
    learned = sph(**scales, sound_speed=5.0, alpha=0.3, beta=0.5)  # in units of half of c
    dynamics, term = dynamics_of(slab, learned, 0.0), learned.terms["wcsph"]
    optimiser = torch.optim.LBFGS(term.parameters(), max_iter=25, tolerance_change=0, line_search_fn="strong_wolfe")

    def loss():
        """Mean square error of the velocity after a few steps, over that of particles that keep theirs."""
        optimiser.zero_grad()
        total = 0.0
        for start, end in zip(states[::8], states[together::8]):
            integrator, particles = VelocityVerlet(dynamics), start
            for _ in range(together):
                particles = integrator.step(particles, step)
            error, change = in_order(particles) - in_order(end), in_order(end) - in_order(start)
            total = total + error.square().sum() / change.square().sum()
        total.backward()
        return total

    optimiser.step(loss)
    found = {name: value.item() for name, value in term.named_parameters()}
    assert found == pytest.approx({"sound_speed": 2.0, "alpha": 2.0, "beta": 2.0}, rel=0.01)
