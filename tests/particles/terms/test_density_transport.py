"""Rates of density: the structured one and the paper's flux."""

import pytest
import torch

from eddies.particles.terms.term import TermError
from tests.particles.configurations import (
    CUTOFF, LENGTH, NEIGHBORS, PAIR_MODELS, SCALES, model, positions, rates, state,
)

pytestmark = pytest.mark.mpi(1)


def test_rate_of_a_uniform_expansion():
    """d rho/dt = -a rho_0 div v: here div v = 3 x 0.2, a = 1; a flux that begins at zero adds nothing."""
    force = model(PAIR_MODELS["corrected"])
    with torch.no_grad():
        force.terms["density-transport"].factors[0] = 1.0
    middle = torch.tensor([[LENGTH / 2] * 3], dtype=torch.float64)
    position = torch.cat([middle, middle + 0.3 * (positions(count=60) - LENGTH / 2)])
    velocity, density = 0.2 * (position - middle), torch.ones(61, dtype=torch.float64)
    assert rates(force, position, velocity, density).density_rate[0].item() == pytest.approx(-0.6, rel=2e-3)


def test_density_relaxes_to_that_of_the_neighbours():
    """b (c/h) (rho_j - rho_i) of one neighbour, but for the small part that keeps sums of weights invertible."""
    force = model(density_transport={})
    with torch.no_grad():
        force.terms["density-transport"].factors.copy_(torch.tensor([0.0, 0.3], dtype=torch.float64))
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.tensor([1.01, 0.98], dtype=torch.float64)
    found = rates(force, position, torch.zeros_like(position), density).density_rate
    w = (1 - (0.5 / CUTOFF) ** 2) ** 2
    expected = 0.3 * SCALES.sound_speed / CUTOFF * -0.03 * w / (w + 1e-3 * 8 / 35 * NEIGHBORS)
    assert found.tolist() == pytest.approx([expected, -expected], rel=1e-10)


def test_it_is_not_regressed_on_single_moments():
    assert not model(PAIR_MODELS["corrected"]).regresses_density
    assert model(PAIR_MODELS["paper"]).regresses_density
    assert not model(pairs={}).regresses_density


def test_a_flux_begins_at_zero_if_it_is_told_to():
    particles = state()
    assert torch.equal(rates(model(density_flux=dict(zero_at_first=True)), *particles).density_rate,
                       torch.zeros(200, dtype=torch.float64))
    force = model(density_flux=dict(zero_at_first=True))
    rates(force, *particles).density_rate.sum().backward()
    assert any(parameter.grad.abs().max() > 0 for parameter in force.parameters())  # and can leave it
    rate = rates(model(density_flux={}), *particles).density_rate
    assert rate.abs().max() > 0


def test_the_flux_between_two_particles():
    """r_rms / n w NN of one neighbour, here with NN = rho'_j - 2 rho'_i."""
    force = model(density_flux=dict(inputs=("density",), network=f"{__name__}:Network"))
    force.terms["density-flux"].network.weights.data = torch.tensor([[-2.0, 1.0]], dtype=torch.float64)
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.tensor([1.01, 0.98], dtype=torch.float64)
    found = rates(force, position, torch.zeros_like(position), density).density_rate
    first, second = 0.01 / SCALES.density, -0.02 / SCALES.density
    unit = SCALES.density_rate / NEIGHBORS * (1 - (0.5 / CUTOFF) ** 2) ** 2
    assert found.tolist() == pytest.approx([unit * (second - 2 * first), unit * (first - 2 * second)], rel=1e-10)


def test_the_flux_has_weights_of_its_own():
    force = model(pairs={}, density_flux={})
    networks = [force.terms[name].network for name in ("pairs", "density-flux")]
    assert not torch.equal(networks[0].weights[0], networks[1].weights[0])
    assert [len(network.biases[-1]) for network in networks] == [2, 1]


def test_zero_at_first_wants_a_network_whose_last_layer_is_known():
    with pytest.raises(TermError, match='term "density-flux": zero_at_first: needs network = "dense"'):
        model(density_flux=dict(zero_at_first=True, network="tests.particles.terms.test_density_transport:Network"))


class Network(torch.nn.Module):
    """A network of a user's."""

    def __init__(self, inputs, hidden, outputs, seed):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.ones(outputs, inputs))

    def forward(self, features):
        return self.weights @ features
