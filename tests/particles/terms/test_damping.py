"""Spectral damping, viscosity and relaxation of a resolved velocity of few modes."""

import math
from dataclasses import replace

import pytest
import torch
from mpi4py import MPI

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_flow import ResolvedFlow
from eddies.particles.terms.damping import RATES
from tests.particles.configurations import CUTOFF, LENGTH, NEIGHBORS, SCALES, dynamics_of, model

pytestmark = pytest.mark.mpi(1)
RESOLVED, CELLS = 6, 18


class Known:
    """In place of what resolves the particles' velocity: modes that are there."""

    def __init__(self, *fields):
        slab = SlabDecomposition(MPI.COMM_SELF, LENGTH, CELLS)
        self.grid = FourierGrid(slab, RESOLVED)
        x, y, z = map(torch.from_numpy, self.grid.spectral.coordinates())
        shape = self.grid.spectral.physical_shape
        self.modes = self.grid.to_modes(torch.stack([each.expand(shape) for each in fields[0](x, y, z)]))

    def of(self, particles, time=None):
        relative = particles.velocity - particles.velocity.mean(0)
        return ResolvedFlow(self.grid, self.modes, self.grid.points(particles.position), relative, SCALES.filter_width)


@torch.no_grad()
def evaluated(lagrangian, field, position, velocity):
    """Rates of particles on the points of the grid, where splines are exact."""
    dynamics = dynamics_of(SlabDecomposition(MPI.COMM_SELF, LENGTH, CELLS), lagrangian, 0.1)
    dynamics.resolution = Known(field)
    return dynamics.rates(ParticleSet(torch.arange(len(position)), position, velocity))


def acceleration(lagrangian, field, position, velocity):
    return evaluated(lagrangian, field, position, velocity).acceleration


def lattice():
    axis = torch.arange(CELLS, dtype=torch.float64) * (LENGTH / CELLS)
    return torch.cartesian_prod(axis, axis, axis)


def waves(x, y, z):
    """Wavenumber 2 in the first component, 5 = |(0, 3, 4)| in the second, the smallest in the third."""
    return torch.sin(2 * y), torch.cos(3 * x) * torch.cos(4 * z), torch.cos(y)


def unit_of_damping(square, wavenumber):
    """k_c times the rms of a component of the one wave above k_c / 2, with the filter undone; its mean square."""
    return RESOLVED * math.sqrt(square * math.exp(wavenumber**2 * SCALES.filter_width**2 / 12) / 3)


def test_each_mode_is_damped_at_the_rate_of_its_wavenumber():
    """Of the six rates, one for each wavenumber here; in units of the wave of the largest."""
    lagrangian = model(damping={})
    with torch.no_grad():
        lagrangian.terms["damping"].rates.copy_(torch.tensor([0.3, 1.1, 0.0, 0.0, 0.7, 0.0], dtype=torch.float64))
    position = lattice()
    force = acceleration(lagrangian, waves, position, torch.zeros_like(position))
    unit = unit_of_damping(square=1 / 4, wavenumber=5)
    for component, (wave, rate) in enumerate(zip(waves(*position.T), (1.1, 0.7, 0.3))):
        assert torch.allclose(force[:, component], -unit * rate * wave, rtol=1e-12, atol=1e-11)


def test_between_the_wavenumbers_of_two_rates_damping_is_linear():
    lagrangian = model(damping={})
    position = lattice()

    def wave(x, y, z):  # |k| = sqrt(10)
        return torch.zeros_like(x), torch.zeros_like(x), torch.cos(x) * torch.sin(3 * y)

    force = acceleration(lagrangian, wave, position, torch.zeros_like(position))
    share = 10**0.5 - 3
    rate = float((1 - share) * RATES[2] + share * RATES[3]) * unit_of_damping(square=1 / 4, wavenumber=10**0.5)
    assert torch.allclose(force[:, 2], -rate * wave(*position.T)[2], rtol=1e-12, atol=1e-12)


def test_what_has_no_small_scales_is_not_damped():
    """Wavenumbers up to half the highest alone."""
    position = lattice()

    def wave(x, y, z):
        return torch.sin(3 * y), torch.cos(2 * z), torch.cos(x) * torch.sin(2 * y)

    assert acceleration(model(damping={}), wave, position, torch.zeros_like(position)).abs().max() < 1e-12


def test_damping_grows_with_the_small_scales_and_not_with_the_large():
    position = lattice()

    def force(large, small):
        def wave(x, y, z):
            return large * torch.sin(y), small * torch.sin(5 * z), torch.cos(2 * x)

        return acceleration(model(damping={}), wave, position, torch.zeros_like(position))[:, 2]

    assert torch.allclose(force(1.0, 0.3), 3 * force(7.0, 0.1), atol=1e-12) and force(1.0, 0.3).abs().max() > 0.01


def test_viscosity_damps_with_the_square_of_the_wavenumber():
    nu = 0.07
    flow = FlowUnits(replace(SCALES, viscosity=nu), CUTOFF, NEIGHBORS)
    position = lattice()
    force = acceleration(model(viscosity={}, flow=flow), waves, position, torch.zeros_like(position))
    for component, (wave, squared) in enumerate(zip(waves(*position.T), (4, 25, 1))):
        assert torch.allclose(force[:, component], -nu * squared * wave, atol=1e-12)


def test_relaxation_takes_what_is_not_resolved_and_keeps_the_momentum():
    position = lattice()
    resolved = torch.stack(waves(*position.T), dim=1)
    missing = 0.1 * torch.randn(position.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(1)) + 0.3
    lagrangian = model(relaxation={})
    with torch.no_grad():
        lagrangian.terms["relaxation"].factor.fill_(1.5)
    force = acceleration(lagrangian, waves, position, resolved + missing)
    rms = math.sqrt((1 / 2 + 1 / 4 + 1 / 2) / 3)
    rate = 1.5 * 2 * rms / SCALES.filter_width
    assert torch.allclose(force, -rate * (missing - missing.mean(0)), atol=1e-12)
    assert force.sum(0).abs().max() < 1e-12 * force.abs().sum()


def test_relaxation_keeps_the_momentum_of_scattered_particles():
    """Over the points of a grid a wave has no mean; over these points what is missing of it has one."""
    generator = torch.Generator().manual_seed(1)
    position = LENGTH * torch.rand((300, 3), dtype=torch.float64, generator=generator)
    missing = 0.1 * torch.randn(position.shape, dtype=torch.float64, generator=generator)
    force = acceleration(model(relaxation={}), waves, position, torch.stack(waves(*position.T), dim=1) + missing)
    assert force.abs().mean() > 0.01
    assert force.sum(0).abs().max() < 1e-12 * force.abs().sum()  # rounding of 300 summands
