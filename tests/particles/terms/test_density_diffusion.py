"""Diffusion of the density between pairs."""

import math

import pytest
import torch

from tests.particles.configurations import CUTOFF, NEIGHBORS, SCALES, model, rates, state

pytestmark = pytest.mark.mpi(1)


@pytest.mark.parametrize("settings, factor", [
    ({}, (1 - (0.5 / CUTOFF) ** 2) ** 2 / NEIGHBORS), (dict(window="none", scaling="root"), 1 / math.sqrt(NEIGHBORS))],
    ids=["in a window", "published"])
def test_the_closed_form_for_two_particles(settings, factor):
    """-r_rms s w (0.1 + 0.1 |q|) q with q = (rho'_i - rho'_j) / (x^2 + 0.1)."""
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.tensor([1.01, 0.98], dtype=torch.float64)
    found = rates(model(density_diffusion=settings), position, torch.zeros_like(position), density).density_rate
    q = 0.03 / SCALES.density / ((0.5 / SCALES.filter_width) ** 2 + 0.1)
    expected = -SCALES.density_rate * factor * 0.1 * (1 + q) * q
    assert found.tolist() == pytest.approx([expected, -expected], rel=1e-10)


def test_its_coefficients_in_physical_units_are_those_of_the_physical_formula():
    """(B_1, B_2) of -s w (B_1 + B_2 |q|) q with q = (rho_i - rho_j)/(x^2 + 0.1 d^2), all in the units of the flow."""
    term = model(density_diffusion=dict(window="none"))
    linear, quadratic = term.learned_coefficients["density-diffusion"]
    assert (linear["unit"], quadratic["unit"]) == ("L^2/T", "L^7/(M T)")
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.tensor([1.01, 0.98], dtype=torch.float64)
    found = rates(term, position, torch.zeros_like(position), density).density_rate
    q = 0.03 / (0.5**2 + 0.1 * SCALES.filter_width**2)
    expected = -(linear["value"] + quadratic["value"] * q) * q / NEIGHBORS
    assert float(found[0]) == pytest.approx(expected, rel=1e-10)


def test_it_evens_out_the_density_and_keeps_its_sum():
    position, velocity, density = state()
    rate = rates(model(density_diffusion={}), position, velocity, density).density_rate
    assert float((rate * (density - density.mean())).sum()) < 0
    assert abs(rate.sum()) < 1e-12 * rate.abs().sum()
