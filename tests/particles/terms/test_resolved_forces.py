"""Pressure, hidden stress and viscosity of a filtered velocity of few modes against the exact ones, both forms of the
stress.

What is expected is made of the unfiltered velocity by plain transforms, never of the terms' own formulas.
"""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.flow.tracers import lattice_positions
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_flow import ResolvedFlow
from tests.particles.configurations import CUTOFF, LENGTH, NEIGHBORS, SCALES, DensityReader, model
from tests.validation.filtered_fields import CELLS, WAVE, Filtered, at, fields_of, modes_of, random_velocity

pytestmark = pytest.mark.mpi(1)
MODES, PLANES, COUNT, NU = random_velocity(4), 48, 400, 0.05


def lagrangian(width, *words, form="gradient", spacing=SCALES.spacing):
    """A model of these terms, and of one that reads a density."""
    flow = FlowUnits(replace(SCALES, filter_width=width, spacing=spacing, viscosity=NU), CUTOFF, NEIGHBORS)
    terms = model({word: dict(form=form) if word == "stress" else {} for word in words}, flow).terms
    return LagrangianModel({**terms, "reader": DensityReader()}, flow)


class Known:
    """In place of what resolves the particles' velocity: the modes that are there."""

    def __init__(self, field, width):
        self.grid = FourierGrid(SlabDecomposition(MPI.COMM_SELF, LENGTH, PLANES), 10)
        coarse = FourierGrid(SlabDecomposition(MPI.COMM_SELF, LENGTH, CELLS), 10)
        self.modes, self.width = coarse.to_modes(torch.from_numpy(fields_of(field.velocity))), width

    def of(self, particles, time):
        points = self.grid.points(particles.position)
        return ResolvedFlow(self.grid, self.modes, points, particles.velocity, self.width)


def particles_in(field, position):
    return ParticleSet(torch.arange(len(position)), torch.from_numpy(position),
                       torch.from_numpy(at(field.velocity, position)))


@torch.no_grad()
def found(field, width, position, *words, form="gradient"):
    """Acceleration and density by terms where the resolved velocity is exact."""
    slab = SlabDecomposition(MPI.COMM_SELF, LENGTH, PLANES)
    dynamics = ParticleDynamics(slab, lagrangian(width, *words, form=form), 0.1)
    dynamics.resolution = Known(field, width)
    rates = dynamics.rates(particles_in(field, position))
    return rates.acceleration.numpy(), rates.density.numpy()


def error(values, exact):
    """Relative error but for the mean, which the terms leave out of the force."""
    difference = values - exact
    return np.linalg.norm(difference - difference.mean(0)) / np.linalg.norm(exact - exact.mean(0))


def unprojected(field):
    """-grad p of the resolved velocity and -div tau as it stands, without its pressure: the mistake."""
    return field.force(NU, hidden=False) - field.stress_divergence()


ALL = "pressure", "stress", "viscosity"


def test_the_force_is_that_of_the_filtered_equations_to_the_fourth_power_of_the_width():
    position = LENGTH * np.random.default_rng(2).random((COUNT, 3))
    errors = {}
    for width in (0.2, 0.4, 0.8):
        field = Filtered(MODES, width)
        exact = at(field.force(NU), position)
        errors[width] = error(found(field, width, position, *ALL)[0], exact)
        # Second order: without the stress, and with a stress whose pressure is left out.
        for wrong in (field.force(NU, hidden=False), unprojected(field)):
            assert error(at(wrong, position), exact) > 4 * errors[width]
    # The gradient model's next order is d^4; at 0.2 the splines' error is of its size.
    assert 12 < errors[0.8] / errors[0.4] < 20
    assert errors[0.4] < 2e-3 and errors[0.2] < 3e-4


def test_by_deconvolution_force_and_density_are_exact():
    """All modes are known, so nothing but the splines' error is left, at any width."""
    position, c = LENGTH * np.random.default_rng(2).random((COUNT, 3)), SCALES.sound_speed
    for width in (0.4, 1.6):
        field = Filtered(MODES, width)
        force, density = found(field, width, position, *ALL, form="deconvolution")
        exact = at(field.force(NU), position)
        assert error(force, exact) < 3e-4
        pressure = at(field.pressure[None], position)[:, 0]
        assert np.linalg.norm((density - 1) * c**2 - pressure) < 3e-4 * np.linalg.norm(pressure)
        # Without the stress's pressure, and without the stress, it is another force.
        for wrong in (unprojected(field), field.force(NU, hidden=False)):
            assert error(at(wrong, position), exact) > 0.02


def test_the_stress_of_the_terms_without_projection_is_another_force():
    """The terms' own modes of div tau, not projected, differ from the exact force as much as no stress does."""
    width, position = 0.4, LENGTH * np.random.default_rng(2).random((COUNT, 3))
    field = Filtered(MODES, width)
    known, exact = Known(field, width), at(field.force(), position)
    grid = known.grid
    slopes = grid.slopes(known.modes)
    divergence = grid.stress_divergence(width**2 / 12 * grid.products(slopes, slopes))
    pressure, both = (found(field, width, position, *words)[0] for words in (("pressure",), ("pressure", "stress")))
    wrong = pressure - grid.at(divergence, torch.from_numpy(position)).numpy()
    assert error(both, exact) < 2e-3 < 0.02 < error(wrong, exact)
    without_its_pressure = at(field.force(hidden=False) - field.stress_divergence(), position)
    assert error(wrong, exact) == pytest.approx(error(without_its_pressure, exact), rel=0.1)


def test_the_density_has_the_pressure_of_the_stress():
    position = LENGTH * np.random.default_rng(2).random((COUNT, 3))
    errors, c = {}, SCALES.sound_speed
    for width in (0.4, 0.8):
        field = Filtered(MODES, width)
        exact = at(field.pressure[None], position)[:, 0]
        density = found(field, width, position, *ALL)[1]
        errors[width] = np.linalg.norm((density - 1) * c**2 - exact) / np.linalg.norm(exact)
        without = found(field, width, position, "pressure")[1]
        assert np.linalg.norm((without - 1) * c**2 - exact) > 4 * errors[width] * np.linalg.norm(exact)
    assert 12 < errors[0.8] / errors[0.4] < 20 and errors[0.4] < 2e-3


def test_force_and_pressure_of_the_exact_stress_are_exact():
    """-grad p_tau - div tau of the stress itself, to round-off."""
    field = Filtered(MODES, 0.8)
    grid = FourierGrid(SlabDecomposition(MPI.COMM_SELF, LENGTH, CELLS), 10)
    entries = field.stress[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    hidden = grid.hidden_stress(grid.to_modes(torch.from_numpy(entries)))
    expected = fields_of(-1j * WAVE * field.hidden_pressure - field.stress_divergence())
    assert np.allclose(grid.to_fields(hidden.force_modes), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    pressure = fields_of(field.hidden_pressure)
    found = grid.to_fields(hidden.pressure_modes[None])[0]
    assert np.allclose(found, pressure, rtol=0, atol=1e-12 * np.abs(pressure).max())
    # Solenoidal: its work on a gradient is nothing.
    assert np.abs((WAVE * modes_of(expected)).sum(0)).max() < 1e-13 * np.abs(expected).max()


def test_the_filtered_equations_hold_for_what_is_called_exact():
    """-grad p_bar - div tau is u_bar.grad u_bar less the solenoidal part of div filtered(u u): another way to it."""
    field = Filtered(MODES, 0.8)
    u_bar = fields_of(field.velocity)
    slopes = fields_of(1j * WAVE * field.velocity[:, None])
    products = modes_of(field.stress + u_bar[:, None] * u_bar)
    change = (1j * WAVE * products).sum(1)
    squared = np.maximum((WAVE**2).sum(0), 1)
    solenoidal = change - WAVE * (WAVE * change).sum(0) / squared
    expected = np.einsum("j...,ij...->i...", u_bar, slopes) - fields_of(solenoidal)
    force = fields_of(field.force())
    assert np.allclose(force, expected, rtol=0, atol=1e-12 * np.abs(force).max())
    position = LENGTH * np.arange(CELLS)[:5, None] / CELLS * [1, 0, 0]
    assert np.allclose(at(field.force(), position), force[:, 0, 0, :5].T, atol=1e-12)


def test_the_force_at_particles_that_resolve_their_velocity():
    """Through the solve: 20^3 particles of wavenumbers up to 3."""
    side, width = 20, 0.8
    position = lattice_positions(3, side, 0, side**3, LENGTH)
    field = Filtered(MODES, width)
    exact, slab = at(field.force(NU), position), SlabDecomposition(MPI.COMM_SELF, LENGTH, 34)
    errors = {}
    with torch.no_grad():
        for form, words in (("deconvolution", ALL), ("gradient", ALL), ("none", ("pressure", "viscosity"))):
            terms = lagrangian(width, *words, form=form, spacing=LENGTH / side)
            rates = ParticleDynamics(slab, terms, 0.0).rates(particles_in(field, position))
            errors[form] = error(rates.acceleration.numpy(), exact)
    # The gradient model's next order alone is 0.023 of the force.
    assert errors["deconvolution"] < 0.01 and errors["gradient"] < 0.03
    assert min(errors["none"], error(at(unprojected(field), position), exact)) > 4 * errors["gradient"]
