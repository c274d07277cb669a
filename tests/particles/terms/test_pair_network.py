"""Properties of every sum over pairs, and the learned force of Eqs. 3 and 4."""

from dataclasses import replace

import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from tests.particles.configurations import (
    CUTOFF, FLOW, LENGTH, NEIGHBORS, PAIR_MODELS, SCALES, given, model, positions, rates, scaled_pairs, state,
)

pytestmark = pytest.mark.mpi(1)
NO_DENSITY = dict(inputs=("distance", "speed", "approach"))
#: Together every term of pairs, both bases and both sets of invariants.
MODELS = {
    "corrected": {"pairs": {}, "density-flux": {}, "continuity": {}, "eddy-viscosity": {}, "density-diffusion": {}},
    "antisymmetric": PAIR_MODELS["antisymmetric"],
    "sph": {"continuity": dict(diffusion=0.1), "wcsph": dict(exponent=7.0), "transport-velocity": {}},
    "without density": {"pairs": NO_DENSITY, "density-flux": NO_DENSITY},
}
every_model = pytest.mark.parametrize("terms", MODELS.values(), ids=MODELS)


def assert_same(actual, expected, tolerance=1e-10):
    actual = given(actual)
    assert actual.keys() == expected.keys()
    for name, reference in expected.items():
        size = max(1.0, float(reference.detach().abs().max()))
        assert torch.allclose(actual[name], reference, rtol=0, atol=tolerance * size), name


@every_model
def test_translation_boost_period_and_order_change_nothing(terms):
    force, particles = model(terms), state()
    position, velocity, density = particles
    expected = given(rates(force, *particles))
    shift = torch.tensor([1.1, -2.3, 0.7], dtype=torch.float64)
    assert_same(rates(force, (position + shift) % LENGTH, velocity + 5 * shift, density), expected)
    periods = LENGTH * torch.randint(-2, 3, (200, 3), generator=torch.manual_seed(1)).double()
    assert_same(rates(force, position + periods, velocity, density), expected)
    order = torch.randperm(200, generator=torch.manual_seed(1))
    assert_same(rates(force, *(column[order] for column in particles)),
                {name: rate[order] for name, rate in expected.items()})


@every_model
def test_rates_turn_with_the_particles(terms):
    """Particles are away from the faces of the box."""
    force, (position, velocity, density) = model(terms), state(60)
    position = LENGTH / 2 + 0.3 * (position - LENGTH / 2)
    turn, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.manual_seed(1)))
    turn = turn * torch.sign(torch.det(turn))
    expected = given(rates(force, position, velocity, density))
    turned = rates(force, LENGTH / 2 + (position - LENGTH / 2) @ turn.T, velocity @ turn.T, density)
    assert_same(turned, {name: rate @ turn.T if rate.dim() == 2 else rate for name, rate in expected.items()})
    assert expected["acceleration"].norm() > 1


@every_model
def test_neighbours_fade_out_at_the_cutoff(terms):
    force, (position, velocity, density) = model(terms), state(3)
    position = torch.full((3, 3), 1.0, dtype=torch.float64)
    position[1, 0] += 0.4
    alone = given(rates(force, position[:2], velocity[:2], density[:2]))
    for distance, most in ((1.0001, 1e-14), (0.99999, 1e-6), (0.7, torch.inf)):
        position[2, 0] = 1.0 - CUTOFF * distance
        with_third = given(rates(force, position, velocity, density))
        for name, expected in alone.items():
            size = max(1.0, float(expected.detach().abs().max()))
            assert (with_third[name][:2] - expected).abs().max() <= most * size


DEGENERATE = {
    "alone": lambda: state(1),
    "coplanar": lambda: (positions(count=30) * torch.tensor([1, 1, 0]), *state(30)[1:]),
    "all the same": lambda: tuple(column[:1].expand(4, *column.shape[1:]).clone() for column in state(4)),
}


@every_model
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_states_have_finite_rates_and_gradients(terms, case):
    force, particles = model(terms), [column.clone().requires_grad_() for column in DEGENERATE[case]()]
    result = given(rates(force, *particles))
    sum((rate**2).sum() for rate in result.values()).backward()
    assert all(torch.isfinite(rate).all() for rate in result.values())
    gradients = [tensor.grad for tensor in (*particles, *force.parameters())]
    assert all(gradient is None or torch.isfinite(gradient).all() for gradient in gradients)
    if case == "alone":
        assert all((rate == 0).all() for name, rate in result.items() if name != "density")


class Constant(torch.nn.Module):
    """NN_1 and NN_2 that are always the same."""

    def __init__(self, along_x, along_v):
        super().__init__()
        self.values = torch.tensor([along_x, along_v], dtype=torch.float64)

    def forward(self, features):
        return self.values[:, None].expand(2, features.shape[1])


@pytest.mark.parametrize("basis", ["paper", "corrected"])
def test_the_sums_of_equation_3_over_one_neighbour(basis):
    """Constant NN: a_rms/n w (2 x + 3 v), or a_rms (2 M^-1 w x + 3 w v / W) with M and W of one neighbour and their
    regularisation, a thousandth of 8/315 n h^2 and of 8/35 n."""
    force = model(pairs=dict(basis=basis))
    force.terms["pairs"].network = Constant(2.0, 3.0)
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    velocity = torch.tensor([[0.0, 0, 0], [0.2, 0.7, 0]], dtype=torch.float64)
    found = rates(force, position, velocity, torch.ones(2, dtype=torch.float64)).acceleration[0]
    w = (1 - (0.5 / CUTOFF) ** 2) ** 2
    x = torch.tensor([-0.5, 0, 0], dtype=torch.float64) / SCALES.filter_width
    v = -velocity[1] / SCALES.velocity
    if basis == "paper":
        expected = w * (2 * x + 3 * v) / NEIGHBORS
    else:
        matrix = w * torch.outer(x, x) + 1e-3 * 8 / 315 * NEIGHBORS * (CUTOFF / SCALES.filter_width) ** 2 * torch.eye(3)
        expected = torch.linalg.solve(matrix, 2 * w * x) + 3 * w * v / (w + 1e-3 * 8 / 35 * NEIGHBORS)
    assert torch.allclose(found, SCALES.acceleration * expected, rtol=1e-12)


def test_forces_scale_with_the_units_of_the_flow():
    """The same network in a flow half as large and three times as fast: the same accelerations in units of a_rms."""
    position, velocity, density = state()
    scales = replace(SCALES, filter_width=SCALES.filter_width / 2, velocity=3 * SCALES.velocity, acceleration=5.0)
    half = FlowUnits(scales, CUTOFF / 2, NEIGHBORS)
    inside = ((position > CUTOFF) & (position < LENGTH - CUTOFF)).all(1)
    first = rates(model(pairs={}), position, velocity, density).acceleration[inside] / SCALES.acceleration
    second = rates(model(pairs={}, flow=half), position / 2 + 1, 3 * velocity, density).acceleration[inside] / 5.0
    assert inside.sum() > 10 and torch.allclose(first, second, atol=1e-11)


def test_inputs_of_the_network():
    particles = state()
    pairs, density = scaled_pairs(*particles), (particles[2] - SCALES.density_mean) / SCALES.density
    own, other = density[pairs.pairs.receiver], density[pairs.pairs.sender]
    everything = pairs.invariants(("density", "distance", "speed", "approach"), symmetric=False)
    x = pairs.pairs.displacement / FLOW.scales.filter_width
    v = (particles[1][pairs.pairs.receiver] - particles[1][pairs.pairs.sender]) / SCALES.velocity
    expected = [own, other, x.norm(dim=1), v.norm(dim=1), (x * v).sum(1)]
    assert torch.allclose(everything, torch.stack(expected), atol=1e-13)
    # In a fixed order, whatever the order of the names.
    assert torch.equal(pairs.invariants(("approach", "distance"), False), everything[[2, 4]])
    assert torch.allclose(pairs.invariants(("density",), True), torch.stack([own + other, (own - other) ** 2]))
