"""The pressure of u = (sin y, sin x, 0): lap p = -2 cos x cos y, so p = cos x cos y."""

import pytest
import torch

from tests.particles.clouds import SCALES, DensityReader, given, model, of_terms
from tests.particles.terms.test_damping import evaluated, lattice

pytestmark = pytest.mark.mpi(1)


def vortices(x, y, z):
    return torch.sin(y), torch.sin(x), torch.zeros_like(x)


def of(*words, **settings):
    return of_terms(*model({word: settings for word in words}).terms.values(), DensityReader())


def test_force_and_density_of_known_vortices():
    position = lattice()
    x, y, _ = position.T
    rates = evaluated(of("pressure"), vortices, position, torch.zeros_like(position))
    force = torch.stack([torch.sin(x) * torch.cos(y), torch.cos(x) * torch.sin(y), 0 * x], dim=1)
    assert torch.allclose(rates.acceleration, force, atol=1e-12)
    expected = SCALES.density_mean * (1 + torch.cos(x) * torch.cos(y) / SCALES.sound_speed**2)
    assert torch.allclose(rates.density, expected, atol=1e-14)


def test_without_its_force_it_gives_the_density_alone():
    position = lattice()
    with_force, without = (evaluated(of("pressure", force=force), vortices, position, torch.zeros_like(position))
                           for force in (True, False))
    assert torch.equal(without.acceleration, torch.zeros_like(position))
    assert torch.equal(without.density, with_force.density)
    assert "acceleration" not in model(pressure=dict(force=False)).gives


def test_stress_of_known_vortices():
    """grad u grad u^T is diagonal with cos^2 y, cos^2 x: its divergence vanishes, and so do force and pressure."""
    position = lattice()
    rates = evaluated(of("stress"), vortices, position, torch.zeros_like(position))
    assert rates.acceleration.abs().max() < 1e-13
    assert (rates.density - SCALES.density_mean).abs().max() < 1e-15


def test_stress_of_crossed_shears():
    """u = (sin y, sin(2 x), 0): tau is diagonal, A d^2/12 (cos^2 y, 4 cos^2 2x), and changes along neither; with
    (0, sin x + sin z, sin x + sin y) tau_yz = cos^2 x is constant along y and z: no force in either. Of
    (0, 0, sin x sin y) the stress is tau_zz alone, constant along z."""
    position = lattice()
    for flow in (lambda x, y, z: (torch.sin(y), torch.sin(2 * x), 0 * x),
                 lambda x, y, z: (0 * x, torch.sin(x) + torch.sin(z), torch.sin(x) + torch.sin(y)),
                 lambda x, y, z: (0 * x, 0 * x, torch.sin(x) * torch.sin(y))):
        assert evaluated(of("stress"), flow, position, torch.zeros_like(position)).acceleration.abs().max() < 1e-12


def test_no_density_is_made_where_nobody_reads_it():
    position = lattice()
    rates = evaluated(model(pressure={}, stress={}), vortices, position, torch.zeros_like(position))
    assert set(given(rates)) == {"acceleration"}
