import math

import pytest
import torch

from tests.particles.configurations import CUTOFF, NEIGHBORS, SCALES, model, rates, state

pytestmark = pytest.mark.mpi(1)


@pytest.mark.parametrize("form", ["two-sided", "monaghan"])
def test_the_closed_form_for_two_particles(form):
    """a_rms / n w Pi x with Pi = -0.1 mu + 0.1 mu^2, mu = x.v / (x^2 + 0.1), in the units of the flow; nothing between
    receding ones if only approaching ones are meant."""
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    for speed in (0.6, -0.6):
        velocity = torch.tensor([[0.0, 0, 0], [speed, 0, 0]], dtype=torch.float64)
        found = rates(model(eddy_viscosity=dict(form=form, basis="paper")), position, velocity).acceleration
        x, v = -0.5 / SCALES.filter_width, -speed / SCALES.velocity
        mu = x * v / (x * x + 0.1) if form == "two-sided" or speed < 0 else 0.0
        expected = SCALES.acceleration / NEIGHBORS * (1 - (0.5 / CUTOFF) ** 2) ** 2 * 0.1 * (mu * mu - mu) * x
        assert float(found[0, 0]) == pytest.approx(expected, rel=1e-12)
        assert torch.equal(found[0], -found[1]) and found[:, 1:].abs().max() == 0


@pytest.mark.parametrize("form", ["two-sided", "bounded"])
@pytest.mark.parametrize("basis", ["paper", "unit"])
def test_the_published_form_for_two_particles(basis, form):
    """a_rms / sqrt(n) Pi b_1 without a window; b_1 is x, or x/|x| to a millionth; "bounded" has tanh(x.v)."""
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0, 0], [0.6, 0, 0]], dtype=torch.float64)
    settings = dict(form=form, basis=basis, window="none", scaling="root")
    found = rates(model(eddy_viscosity=settings), position, velocity).acceleration
    x, v = -0.5 / SCALES.filter_width, -0.6 / SCALES.velocity
    mu = (math.tanh(x * v) if form == "bounded" else x * v) / (x * x + 0.1)
    expected = SCALES.acceleration / math.sqrt(NEIGHBORS) * 0.1 * (mu * mu - mu) * (x if basis == "paper" else -1)
    assert float(found[0, 0]) == pytest.approx(expected, rel=1e-5)


def test_its_coefficients_in_physical_units_are_those_of_the_physical_formula():
    """(A_1, A_2) of a = s w (-A_1 mu + A_2 mu^2) x/d with mu = x.v/(x^2 + 0.1 d^2), all in the units of the flow."""
    term = model(eddy_viscosity=dict(basis="paper", window="none"))
    linear, quadratic = term.learned_coefficients["eddy-viscosity"]
    assert [(each["learned"], each["unit"]) for each in (linear, quadratic)] == [(0.1, "L/T"), (0.1, "L")]
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0, 0], [0.6, 0, 0]], dtype=torch.float64)
    found = rates(term, position, velocity).acceleration
    mu = 0.5 * 0.6 / (0.5**2 + 0.1 * SCALES.filter_width**2)
    expected = (-linear["value"] * mu + quadratic["value"] * mu**2) * -0.5 / SCALES.filter_width / NEIGHBORS
    assert float(found[0, 0]) == pytest.approx(expected, rel=1e-12)


def test_it_takes_energy_of_approaching_pairs_and_keeps_the_momentum():
    position, velocity, _ = state()
    force = rates(model(eddy_viscosity=dict(form="monaghan", basis="paper")), position, velocity).acceleration
    assert float((force * velocity).sum()) < 0
    assert force.sum(0).abs().max() < 1e-12 * force.abs().sum()


def test_added_to_a_network_it_is_what_it_is_alone():
    particles = state()
    settings = dict(form="monaghan")
    alone, network, both = (rates(model(terms), *particles).acceleration for terms in (
        {"eddy-viscosity": settings}, {"pairs": {}}, {"pairs": {}, "eddy-viscosity": settings}))
    assert torch.allclose(both, alone + network, atol=1e-12)
