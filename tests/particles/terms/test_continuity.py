"""The density equation of SPH, alone and with the forces of WCSPH."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.smoothing_kernels import CubicSpline
from tests.particles.configurations import (
    LENGTH, SCALES, alone, assert_close, by_id, distributed, dynamics_of, model, rates, state, summed_density,
)

SIDE = 10
SPACING = LENGTH / SIDE
C = SCALES.sound_speed
# As many neighbours as the default has, 57 in the lattice.
FLOW = FlowUnits(replace(SCALES, spacing=SPACING), SPACING * (60 / (4 / 3 * math.pi)) ** (1 / 3), 60.0)


def lattice(disorder=0.0):
    """Positions (n, 3), each moved by up to `disorder` spacings to either side along the axes."""
    moved = np.random.default_rng(4).uniform(-disorder, disorder, (SIDE**3, 3))
    return torch.as_tensor((np.argwhere(np.ones((SIDE,) * 3)) + 0.5 + moved) * SPACING)


def smoothed(flow=FLOW, **more):
    """The equation of the density, and settings of other terms."""
    return model({"continuity": {}, **more}, flow)


@pytest.mark.mpi(1)
def test_uniform_expansion_thins_by_three_times_its_rate(comm):
    """d rho/dt = -3 a rho for v = a x, of particles that do not see the ends of the box. The sum over the lattice is
    the integral of r dW/dr, -3, but for a percent."""
    position = lattice()
    inside = ((position - LENGTH / 2).abs() < LENGTH / 2 - FLOW.cutoff).all(1)
    density = torch.full((SIDE**3,), 1.3, dtype=torch.float64)
    dense = replace(FLOW, scales=replace(FLOW.scales, density_mean=1.3))
    found = rates(smoothed(dense), position, 0.2 * (position - LENGTH / 2), density).density_rate[inside]
    assert len(found) > 50 and np.ptp(found.numpy()) < 1e-12
    assert found[0].item() == pytest.approx(-3 * 0.2 * 1.3, rel=0.02)


@pytest.mark.mpi(1)
def test_a_summed_density_changes_alike(comm):
    """Of equal densities the rate is the time derivative of sum_j m W: what approaches grows denser."""
    position, velocity, _ = state(150)
    flow = replace(FLOW, cutoff=1.5)
    density = torch.ones(150, dtype=torch.float64)
    found = rates(smoothed(flow), position, velocity, density).density_rate
    ends = [summed_density((position + moved * velocity) % LENGTH, CubicSpline(1.5), flow.particle_mass)
            for moved in (1e-5, -1e-5)]
    assert torch.allclose(found, (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-6)


@pytest.mark.mpi(1)
def test_diffusion_smooths_at_its_rate_and_keeps_the_volume(comm):
    """delta h c laplacian rho: of a wave over eight supports; its sum over rho is zero, as pairs give and take alike.
    A delta with the other sign does the same."""
    position = lattice()
    density = 1 + 1e-4 * torch.cos(position[:, 0])
    for delta in (0.1, -0.1):
        force = smoothed(continuity=dict(diffusion=0.1))
        with torch.no_grad():
            force.terms["continuity"].delta.fill_(delta)
        found = rates(force, position, torch.zeros_like(position), density).density_rate.detach()
        expected = -0.1 * FLOW.cutoff / 2 * C * (density - 1)
        assert torch.allclose(found, expected, rtol=0, atol=0.06 * float(expected.abs().max()))
        assert abs(float((found / density).sum())) < 1e-12 * float(found.abs().sum())


@pytest.mark.mpi(1)
def test_without_diffusion_nothing_is_learned_and_the_rate_not_fitted(comm):
    plain, diffusive = (model({"continuity": dict(diffusion=delta), "wcsph": {}}) for delta in (0.0, 0.1))
    assert not plain.terms["continuity"].state_dict() and plain.integrates_density
    assert not plain.learns_density and not plain.regresses_density
    assert diffusive.learns_density and not diffusive.regresses_density
    assert plain.terms["continuity"].settings.learns_through_horizons is False


@pytest.mark.mpi(1)
def test_sound_has_the_frequency_c_k(comm):
    """Of a standing wave with sin kx, k = 1, over three quarters of a period. Sums over the lattice are derivatives of
    what the kernel smooths, which leaves of the wave the kernel's Fourier transform, 0.92: with that the frequency is
    right to two percent, as sums over 57 neighbours are not quite integrals."""
    position = lattice()
    wave = 1e-4 * torch.sin(position[:, :1])
    slab, particles = distributed(comm, position, torch.cat([wave, 0 * wave, 0 * wave], 1),
                                  torch.ones(SIDE**3, dtype=torch.float64))
    lagrangian = smoothed(wcsph=dict(alpha=0.0, beta=0.0))
    stepper, steps = INTEGRATORS["rk4"](dynamics_of(slab, lagrangian, 0.1)), 24
    phases = []
    with torch.no_grad():
        for _ in range(steps):
            particles = stepper.step(particles, 1.5 * math.pi / C / steps)
            columns = (by_id(comm, particles, column, SIDE**3) for column in (particles.velocity, particles.density))
            velocity, density = ((column.T @ mode).numpy() for column, mode in zip(
                columns, (torch.sin(position[:, 0]), torch.cos(position[:, 0]))))
            phases.append(math.atan2(-C * density, velocity[0]))
    turned = np.unwrap(phases)[-1]
    r = torch.linspace(0, FLOW.cutoff, 2001, dtype=torch.float64)
    left = float(torch.trapezoid(4 * math.pi * r * torch.sin(r) * lagrangian.terms["wcsph"].kernel.value(r), r))
    assert 0.88 < left < 0.95 and turned == pytest.approx(1.5 * math.pi * left, rel=0.02)


@pytest.mark.mpi(1, 2, 3)
def test_momentum_is_kept_and_ranks_do_not_matter(comm):
    position, velocity, density = state(200)
    slab, particles = distributed(comm, position, velocity, density)
    lagrangian = model({"continuity": dict(diffusion=0.1), "wcsph": {}})
    found = dynamics_of(slab, lagrangian).rates(particles)
    expected = rates(lagrangian, position, velocity, density)
    acceleration, rate = (by_id(comm, particles, column, 200) for column in (found.acceleration, found.density_rate))
    assert_close(acceleration, expected.acceleration, 1e-11)
    assert_close(rate, expected.density_rate, 1e-11)
    assert float(acceleration.sum(0).abs().max()) < 1e-12 * float(acceleration.abs().sum())


@pytest.mark.mpi(1)
def test_signs_of_coefficients_do_not_matter(comm):
    """Pressure pushes and friction takes energy, wherever training leads."""
    particles = state(100)
    found = []
    for sign in (1, -1):
        force = model({"continuity": {}, "wcsph": {}})
        with torch.no_grad():
            for name in ("sound_speed", "alpha", "beta"):
                getattr(force.terms["wcsph"], name).mul_(sign)
        found.append(rates(force, *particles).acceleration)
    assert torch.equal(*found)


@pytest.mark.mpi(1)
def test_a_wave_loses_what_viscosity_takes(comm):
    """Energy of motion and of compression is kept without viscosity, and falls with it."""
    position = lattice(0.2)
    velocity = torch.sin(position[:, [1, 2, 0]])
    slab, start = alone(position, velocity, torch.ones(SIDE**3, dtype=torch.float64))
    lost = {}
    for alpha in (0.0, 1.0):
        stepper = INTEGRATORS["rk4"](dynamics_of(slab, smoothed(wcsph=dict(alpha=alpha, beta=0.0)), 0.1))
        particles = start
        with torch.no_grad():
            for _ in range(10):
                particles = stepper.step(particles, 0.01)
        rho = particles.density
        kinetic = particles.velocity.square().sum() / 2
        elastic = (C**2 * (rho.log() + 1 / rho - 1)).sum()
        lost[alpha] = 1 - float(kinetic + elastic) / float(velocity.square().sum() / 2)
    assert abs(lost[0.0]) < 1e-4 and lost[1.0] > 0.05
