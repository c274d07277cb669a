"""Smoothed particle hydrodynamics: density equation, WCSPH and transport velocity."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.scene.terms import PRESETS
from tests.particles.configurations import (
    LENGTH, SCALES, by_id, distributed, dynamics_of, lattice, model, rates, state, summed_density,
)

SIDE = 10
SPACING, C = LENGTH / SIDE, SCALES.sound_speed
# The default number of neighbours, 57 in the lattice.
FLOW = FlowUnits(replace(SCALES, spacing=SPACING), SPACING * (60 / (4 / 3 * math.pi)) ** (1 / 3), 60.0)
ONES = torch.ones(SIDE**3, dtype=torch.float64)
REST = torch.zeros(SIDE**3, 3, dtype=torch.float64)
one_rank = pytest.mark.mpi(1)


# ---- the density equation


@one_rank
def test_a_summed_density_changes_at_the_same_rate(comm):
    """The rate for equal densities is the time derivative of sum_j m W."""
    position, velocity, _ = state(150)
    flow = replace(FLOW, cutoff=1.5)
    found = rates(model({"continuity": {}}, flow), position, velocity, ONES[:150]).density_rate
    ends = [summed_density((position + time * velocity) % LENGTH, CubicSpline(1.5), flow.particle_mass)
            for time in (1e-5, -1e-5)]
    assert torch.allclose(found, (ends[0] - ends[1]) / 2e-5, rtol=1e-6, atol=1e-6)


@one_rank
def test_diffusion_smooths_at_its_rate_and_conserves_the_volume(comm):
    """delta h c laplacian rho for a wave over eight supports. The sum of the rate over rho is zero. The sign of delta
    does not matter."""
    position = lattice(SIDE)
    density = 1 + 1e-4 * torch.cos(position[:, 0])
    for sign in (1, -1):
        force = model({"continuity": dict(diffusion=0.1)}, FLOW)
        with torch.no_grad():
            force.terms["continuity"].delta.mul_(sign)
        found = rates(force, position, REST, density).density_rate.detach()
        expected = -0.1 * FLOW.cutoff / 2 * C * (density - 1)
        assert torch.allclose(found, expected, rtol=0, atol=0.06 * float(expected.abs().max()))
        assert abs(float((found / density).sum())) < 1e-12 * float(found.abs().sum())
    assert not model({"continuity": {}, "wcsph": {}}).learns_density and not force.regresses_density


# ---- WCSPH

COUNT, SUPPORT = 200, 1.5
MASS = LENGTH**3 / COUNT
TRUE = {"alpha": 1.0, "beta": 2.0, "exponent": 7.0}


def sph(spacing=MASS ** (1 / 3), support=SUPPORT, c=10.0, **values):
    """Continuity and forces; a particle has the mass of a cube of the spacing."""
    flow = FlowUnits(replace(SCALES, spacing=spacing, sound_speed=c), support, 20.0)
    return model({"continuity": {}, "wcsph": TRUE | values}, flow)


def acceleration(position, velocity, density, **values):
    return rates(sph(**values), position, velocity, density).acceleration.detach()


@one_rank
def test_pressure_is_the_gradient_of_the_internal_energy(comm):
    """Without viscosity and with a summed density, a_i = -d/dx_i sum_j e(rho_j) with de/drho = P / rho^2."""
    position, velocity, _ = state(COUNT)
    c, gamma, moved = 3.0, 2.5, position.clone().requires_grad_(True)
    density = summed_density(moved, CubicSpline(SUPPORT), MASS)
    found = acceleration(position, velocity, density.detach(), c=2 * c, speed=0.5, alpha=0.0, beta=0.0, exponent=gamma)
    energy = c**2 / gamma * (density ** (gamma - 1) / (gamma - 1) + 1 / density)
    (gradient,) = torch.autograd.grad(energy.sum(), moved)
    assert (found + gradient).abs().max() < 1e-11 * found.abs().max()


@one_rank
def test_viscosity_acts_on_approaching_pairs_and_dissipates_energy(comm):
    position, velocity, density = state(COUNT)
    viscous = acceleration(position, velocity, density) - acceleration(position, velocity, density, alpha=0.0, beta=0.0)
    assert float((viscous * velocity).sum()) < 0
    # Monaghan's closed form for a pair that moves along its line, or nothing.
    r, h, two = 0.4, SUPPORT / 2, torch.tensor([[1.0, 1, 1], [1.4, 1, 1]], dtype=torch.float64)
    density = torch.tensor([0.9, 1.3], dtype=torch.float64)
    for speed in (-0.5, 0.5):
        away = torch.tensor([[0.0, 0, 0], [speed, 0, 0]], dtype=torch.float64)
        moving, resting = (acceleration(two, each, density) for each in (away, torch.zeros_like(two)))
        mu = min(h * r * speed / (r**2 + 0.01 * h**2), 0)
        expected = (-10 * mu + 2 * mu**2) / 1.1
        slope = float(CubicSpline(SUPPORT).derivative(torch.tensor(r, dtype=torch.float64)))
        assert float((moving - resting)[1, 0]) == pytest.approx(-MASS * expected * slope, rel=1e-12, abs=1e-12)


@one_rank
def test_sound_has_the_frequency_c_k(comm):
    """A standing wave with sin kx, k = 1, over three quarters of a period. The sums see the smoothed wave, whose
    amplitude is the kernel's Fourier transform, 0.92. Sums over 57 neighbours are integrals to two percent."""
    position = lattice(SIDE)
    wave = 1e-4 * torch.sin(position[:, :1])
    slab, particles = distributed(comm, position, torch.cat([wave, 0 * wave, 0 * wave], 1), ONES)
    force = model({"continuity": {}, "wcsph": dict(alpha=0.0, beta=0.0)}, FLOW)
    stepper, steps, phases = INTEGRATORS["rk4"](dynamics_of(slab, force, 0.1)), 16, []
    with torch.no_grad():
        for _ in range(steps):
            particles = stepper.step(particles, 1.5 * math.pi / C / steps)
            velocity, density = (by_id(comm, particles, column, SIDE**3)
                                 for column in (particles.velocity[:, 0], particles.density))
            phases.append(math.atan2(-C * float(density @ torch.cos(position[:, 0])),
                                     float(velocity @ torch.sin(position[:, 0]))))
    r = torch.linspace(0, FLOW.cutoff, 2001, dtype=torch.float64)
    left = float(torch.trapezoid(4 * math.pi * r * torch.sin(r) * CubicSpline(FLOW.cutoff).value(r), r))
    assert 0.88 < left < 0.95 and np.unwrap(phases)[-1] == pytest.approx(1.5 * math.pi * left, rel=0.02)


# ---- transport velocity


@pytest.mark.mpi(1, 3)
def test_disordered_particles_spread_out_in_a_fluid_at_rest(comm):
    """The closest particles separate, and cells of two spacings hold more equal numbers. Velocity and density of the
    fluid do not change, nor does the centre of mass."""
    start = lattice(SIDE, 0.9)
    slab, particles = distributed(comm, start, REST, ONES)
    stepper = INTEGRATORS["rk3"](dynamics_of(slab, model(PRESETS["transport-velocity"], FLOW), 0.3))
    moved = torch.zeros_like(start)
    with torch.no_grad():
        for _ in range(15):
            particles, shift = stepper.rates(particles)
            moved += 0.01 * by_id(comm, particles, shift.shift_velocity, SIDE**3)
            particles = stepper.step(particles, 0.01)
    end = by_id(comm, particles, particles.position, SIDE**3) % LENGTH

    def nearest(position):
        apart = position[:, None] - position
        square = (apart - LENGTH * torch.round(apart / LENGTH)).square().sum(-1)
        return square.fill_diagonal_(torch.inf).min(1).values.sqrt()

    spread = [np.histogramdd(position.numpy(), bins=[np.linspace(0, LENGTH, SIDE // 2 + 1)] * 3)[0].var()
              for position in (start % LENGTH, end)]
    assert spread[1] < 0.5 * spread[0] and nearest(end).min() > 2 * nearest(start).min()
    assert moved.square().mean().sqrt() > 0.1 * SPACING and moved.mean(0).abs().max() < 1e-12
    assert not particles.velocity.any() and torch.equal(particles.density, ONES[: len(particles)])
    still = rates(model({"transport-velocity": {}}, FLOW), lattice(SIDE), REST, ONES).shift_velocity
    assert still.abs().max() < 1e-12 * C  # a lattice is in equilibrium


@one_rank
def test_the_first_background_pressure_is_that_of_adami():
    """c^2 rho_0, for a step of h/(4c); h is half the radius of the kernel."""
    (found,) = model({"transport-velocity": {}}, FLOW).terms["transport-velocity"].learned_coefficients
    assert found.value == pytest.approx(C**2 * SCALES.density_mean * FLOW.cutoff / 2 / (4 * C), rel=1e-12)


@one_rank
def test_the_velocity_follows_the_field_along_the_shift(comm):
    """(w.grad) v of a shear wave (sin z, 0, 0), to a sixth among slightly disordered particles. A uniform velocity in
    addition changes nothing."""
    position = lattice(SIDE, 0.1)
    wave = torch.zeros_like(position)
    wave[:, 0] = torch.sin(position[:, 2])
    force = model({"transport-velocity": {}}, FLOW)
    found = rates(force, position, wave, ONES)
    expected = found.shift_velocity[:, 2] * torch.cos(position[:, 2])
    assert (found.shift_acceleration[:, 0] - expected).norm() < expected.norm() / 6
    assert not found.shift_acceleration[:, 1:].any() and found.acceleration.abs().max() == 0
    carried = rates(force, position, wave + torch.tensor([3.0, -7, 2]), ONES)
    assert torch.allclose(carried.shift_acceleration, found.shift_acceleration, rtol=0, atol=1e-12)
