"""The paper's rate of density."""

import pytest
import torch

from tests.particles.configurations import CUTOFF, NEIGHBORS, PAIR_MODELS, SCALES, model, rates

pytestmark = pytest.mark.mpi(1)


def test_it_is_regressed_on_single_moments_unless_another_rate_of_density_is_not():
    assert not model(PAIR_MODELS["corrected"]).regresses_density
    assert model(PAIR_MODELS["paper"]).regresses_density
    assert not model(pairs={}).regresses_density


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


def test_the_sign_of_the_density_difference():
    """What the denser particle of a pair gets has the sign of the network's output, the other one the opposite."""
    force = model(density_flux=dict(inputs=("distance",), network=f"{__name__}:Network", sign=True))
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.tensor([1.01, 0.98], dtype=torch.float64)
    found = rates(force, position, torch.zeros_like(position), density).density_rate
    unit = SCALES.density_rate / NEIGHBORS * (1 - (0.5 / CUTOFF) ** 2) ** 2 * 0.5 / SCALES.filter_width
    assert found.tolist() == pytest.approx([unit, -unit], rel=1e-10)


def test_the_flux_has_weights_of_its_own():
    force = model(pairs={}, density_flux={})
    networks = [force.terms[name].network for name in ("pairs", "density-flux")]
    assert not torch.equal(networks[0].weights[0], networks[1].weights[0])
    assert [len(network.biases[-1]) for network in networks] == [2, 1]


class Network(torch.nn.Module):
    """A network of a user's."""

    def __init__(self, inputs, hidden, outputs, seed):
        super().__init__()
        self.weights = torch.nn.Parameter(torch.ones(outputs, inputs))

    def forward(self, features):
        return self.weights @ features
