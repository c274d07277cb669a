"""Eddy viscosity, density diffusion and density flux between two particles in closed form."""

import math

import pytest
import torch

from tests.particles.configurations import CUTOFF, NEIGHBORS, OPEN, SCALES, model, rates

pytestmark = pytest.mark.mpi(1)
POSITION = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
DENSITY = torch.tensor([1.01, 0.98], dtype=torch.float64)
WINDOW = (1 - (0.5 / CUTOFF) ** 2) ** 2 / NEIGHBORS
X = -0.5 / SCALES.filter_width


def moving(speed):
    return torch.tensor([[0.0, 0, 0], [speed, 0, 0]], dtype=torch.float64)


@pytest.mark.parametrize("form, speed", [("two-sided", 0.6), ("two-sided", -0.6), ("monaghan", 0.6), ("monaghan", -0.6),
                                         ("bounded", -0.6)])
@pytest.mark.parametrize("basis, settings, factor", [
    ("paper", {}, WINDOW * X), ("paper", OPEN, X / math.sqrt(NEIGHBORS)), ("unit", OPEN, -1 / math.sqrt(NEIGHBORS))])
def test_friction_of_two_particles(basis, settings, factor, form, speed):
    """a_rms s w Pi b_1 with Pi = -0.1 mu + 0.1 mu^2, mu = x.v / (x^2 + 0.1), b_1 = x or x/|x| to a millionth. "bounded"
    has tanh(x.v), and "monaghan" acts on approaching pairs only."""
    term = model(eddy_viscosity=dict(form=form, basis=basis, **settings))
    force = rates(term, POSITION, moving(speed)).acceleration
    approach = X * -speed / SCALES.velocity
    mu = (math.tanh(approach) if form == "bounded" else approach) / (X * X + 0.1)
    mu = min(mu, 0) if form == "monaghan" else mu
    expected = SCALES.acceleration * factor * 0.1 * (mu * mu - mu)
    assert float(force[0, 0]) == pytest.approx(expected, rel=1e-5 if basis == "unit" else 1e-12)
    assert torch.equal(force[0], -force[1]) and force[:, 1:].abs().max() == 0


@pytest.mark.parametrize("settings, factor", [({}, WINDOW), (OPEN, 1 / math.sqrt(NEIGHBORS))])
def test_density_diffusion_of_two_particles(settings, factor):
    """-r_rms s w (0.1 + 0.1 |q|) q with q = (rho'_i - rho'_j) / (x^2 + 0.1)."""
    found = rates(model(density_diffusion=settings), POSITION, moving(0.0), DENSITY).density_rate
    q = 0.03 / SCALES.density / (X * X + 0.1)
    expected = -SCALES.density_rate * factor * 0.1 * (1 + q) * q
    assert found.tolist() == pytest.approx([expected, -expected], rel=1e-10)


def test_coefficients_in_physical_units_are_those_of_the_physical_formulas():
    """a = s (-A_1 mu + A_2 mu^2) x/d with mu = x.v/(x^2 + 0.1 d^2), and d rho/dt = -s (B_1 + B_2 |q|) q with
    q = (rho_i - rho_j)/(x^2 + 0.1 d^2)."""
    soft = 0.5**2 + 0.1 * SCALES.filter_width**2
    term = model(eddy_viscosity=dict(basis="paper", window="none"))
    linear, quadratic = term.learned_coefficients["eddy-viscosity"]
    assert [(each["learned"], each["unit"]) for each in (linear, quadratic)] == [(0.1, "L/T"), (0.1, "L")]
    mu = 0.5 * 0.6 / soft
    expected = (-linear["value"] * mu + quadratic["value"] * mu**2) * X / NEIGHBORS
    assert float(rates(term, POSITION, moving(0.6)).acceleration[0, 0]) == pytest.approx(expected, rel=1e-12)
    term = model(density_diffusion=dict(window="none"))
    linear, quadratic = term.learned_coefficients["density-diffusion"]
    assert (linear["unit"], quadratic["unit"]) == ("L^2/T", "L^7/(M T)")
    q = 0.03 / soft
    expected = -(linear["value"] + quadratic["value"] * q) * q / NEIGHBORS
    assert float(rates(term, POSITION, moving(0.0), DENSITY).density_rate[0]) == pytest.approx(expected, rel=1e-10)


class Network(torch.nn.Module):
    """A user's network: a weighted sum of its inputs."""

    def __init__(self, inputs, hidden, outputs, seed):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.ones(outputs, inputs))

    def forward(self, features):
        return self.weights @ features


def test_density_flux_of_two_particles():
    """r_rms / n w NN, with NN = rho'_j - 2 rho'_i; and with NN = |x| times the sign of the density difference."""
    force = model(density_flux=dict(inputs=("density",), network=f"{__name__}:Network"))
    force.terms["density-flux"].network.weights.data = torch.tensor([[-2.0, 1.0]], dtype=torch.float64)
    found = rates(force, POSITION, moving(0.0), DENSITY).density_rate
    first, second = 0.01 / SCALES.density, -0.02 / SCALES.density
    unit = SCALES.density_rate * WINDOW
    assert found.tolist() == pytest.approx([unit * (second - 2 * first), unit * (first - 2 * second)], rel=1e-10)
    force = model(density_flux=dict(inputs=("distance",), network=f"{__name__}:Network", sign=True))
    found = rates(force, POSITION, moving(0.0), DENSITY).density_rate
    assert found.tolist() == pytest.approx([unit * -X, unit * X], rel=1e-10)
