"""The pressure of u = (sin y, sin x, 0): lap p = -2 cos x cos y, so p = cos x cos y."""

import math

import pytest
import torch

from tests.particles.configurations import SCALES, DensityReader, given, model, of_terms
from tests.particles.terms.test_damping import evaluated, lattice

pytestmark = pytest.mark.mpi(1)
every_form = pytest.mark.parametrize("form", ["deconvolution", "gradient"])


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


@every_form
def test_stress_of_known_vortices(form):
    """tau is diagonal, made of cos 2y and cos 2x: its divergence vanishes, and so do force and pressure."""
    position = lattice()
    rates = evaluated(of("stress", form=form), vortices, position, torch.zeros_like(position))
    assert rates.acceleration.abs().max() < 1e-13
    assert (rates.density - SCALES.density_mean).abs().max() < 1e-15


@every_form
def test_stress_of_crossed_shears(form):
    """What two waves hide together goes with the product of their wave vectors, here zero. u = (sin y, sin(2 x), 0):
    tau is diagonal, of cos 2y and cos 4x, and changes along neither; with (0, sin x + sin z, sin x + sin y) tau_yz
    changes along x alone, tau_yy along x and z: no force in either. Of (0, 0, sin x sin y) the stress is tau_zz alone,
    constant along z."""
    position = lattice()
    for flow in (lambda x, y, z: (torch.sin(y), torch.sin(2 * x), 0 * x),
                 lambda x, y, z: (0 * x, torch.sin(x) + torch.sin(z), torch.sin(x) + torch.sin(y)),
                 lambda x, y, z: (0 * x, 0 * x, torch.sin(x) * torch.sin(y))):
        force = evaluated(of("stress", form=form), flow, position, torch.zeros_like(position)).acceleration
        assert force.abs().max() < 1e-12


@every_form
def test_stress_of_two_waves_at_an_angle(form):
    """A filter of transfer exp(-k^2 d^2 / 24) hides exp(-p.q d^2/12) - 1 of the product of waves p and q, to leading
    order -p.q d^2/12. Of u = (sin(x + y), -sin(x + y), sin x) the waves make T = tau_zx = -tau_zy with cos y, the
    difference, and cos(2x + y), the sum, p.q = -1 and 1; the force is d_y T - d_x T along z, without a pressure."""
    position = lattice()
    x, y, _ = position.T

    def waves(x, y, z):
        return torch.sin(x + y), -torch.sin(x + y), torch.sin(x)

    h = SCALES.filter_width**2 / 12
    apart, together = (math.expm1(h), math.expm1(-h)) if form == "deconvolution" else (h, -h)
    # T = (apart cos y - together cos(2x + y)) / 2
    expected = -(apart * torch.sin(y) + together * torch.sin(2 * x + y)) / 2
    rates = evaluated(of("stress", form=form), waves, position, torch.zeros_like(position))
    assert torch.allclose(rates.acceleration, torch.stack([0 * x, 0 * x, expected], dim=1), atol=1e-13)
    assert (rates.density - SCALES.density_mean).abs().max() < 1e-15


def test_no_density_is_made_where_nobody_reads_it():
    position = lattice()
    rates = evaluated(model(pressure={}, stress={}), vortices, position, torch.zeros_like(position))
    assert set(given(rates)) == {"acceleration"}
