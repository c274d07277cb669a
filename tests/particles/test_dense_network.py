import pytest
import torch

from eddies.particles.dense_network import DenseNetwork


def by_hand(network, features):
    values = features
    for weight, bias in zip(network.weights[:-1], network.biases[:-1]):
        values = torch.tanh(weight @ values + bias)
    return network.weights[-1] @ values + network.biases[-1]


@pytest.mark.parametrize("hidden", [(7,), (20, 100, 20)])
def test_layers_are_tanh_layers_with_a_tangent(hidden):
    network = DenseNetwork(5, hidden, 3, seed=2)
    with torch.no_grad():
        for bias in network.biases:
            bias.uniform_(-1, 1)
    features, tangent = torch.randn(2, 5, 50, dtype=torch.float64)
    assert torch.allclose(network(features), by_hand(network, features), atol=1e-13)
    expected = torch.autograd.functional.jvp(lambda x: by_hand(network, x), features, tangent)
    assert all(map(torch.allclose, network.with_tangent(features, tangent), expected))


def test_initial_weights_are_glorot_normal_and_repeatable():
    network = DenseNetwork(100, (300,), 1, seed=4)
    assert float(network.weights[0].detach().std()) == pytest.approx((2 / 400) ** 0.5, rel=0.03)
    assert torch.equal(network.weights[0], DenseNetwork(100, (300,), 1, seed=4).weights[0])
    assert not torch.equal(network.weights[0], DenseNetwork(100, (300,), 1, seed=5).weights[0])
