import itertools
import json

import pytest
import torch
from clouds import CUTOFF, LENGTH, SCALES, cloud, model, rates, state

from eddies.particles import moments
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pair_forces import BASES, CLOSURES, EDDY_VISCOSITIES, PairModel
from eddies.particles.periodic_box import PeriodicBox

CHOICES = [
    dict(zip(("basis", "closure", "eddy_viscosity"), choice))
    for choice in itertools.product(sorted({*BASES} - {"none"}), CLOSURES, EDDY_VISCOSITIES)
]
ANTISYMMETRIC = [dict(basis="paper", closure=closure, eddy_viscosity="monaghan", symmetry="antisymmetric")
                 for closure in ("poisson", "learned-density")]
CHOICES += ANTISYMMETRIC
every_model = pytest.mark.parametrize("choices", CHOICES, ids=lambda choices: " ".join(choices.values()))


def assert_same(actual, expected, tolerance=1e-10):
    assert actual.keys() == expected.keys()
    for name in expected:
        assert torch.allclose(actual[name], expected[name], rtol=0, atol=tolerance), name


def rotation(seed=1):
    matrix, _ = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.manual_seed(seed)))
    return matrix * torch.sign(torch.det(matrix))


@every_model
def test_translation_boost_and_period_change_nothing(choices):
    force, (position, velocity, density) = model(**choices), state()
    expected = rates(force, position, velocity, density)
    shift = torch.tensor([1.1, -2.3, 0.7], dtype=torch.float64)
    assert_same(rates(force, (position + shift) % LENGTH, velocity + 5 * shift, density), expected)
    periods = LENGTH * torch.randint(-2, 3, (200, 3), generator=torch.manual_seed(1)).double()
    assert_same(rates(force, position + periods, velocity, density), expected)


@every_model
def test_rates_turn_with_the_particles(choices):
    # Far from the faces, so that the box has no say.
    force, (position, velocity, density) = model(**choices), state(60)
    position, turn = LENGTH / 2 + 0.3 * (position - LENGTH / 2), rotation()
    expected = rates(force, position, velocity, density)
    turned = rates(force, LENGTH / 2 + (position - LENGTH / 2) @ turn.T, velocity @ turn.T, density)
    assert_same(turned, {**expected, "velocity": expected["velocity"] @ turn.T})
    assert expected["velocity"].norm() > 1


@every_model
def test_order_of_particles_does_not_matter(choices):
    force, particles = model(**choices), state()
    order = torch.randperm(200, generator=torch.manual_seed(1))
    expected = {name: rate[order] for name, rate in rates(force, *particles).items()}
    assert_same(rates(force, *(column[order] for column in particles)), expected)


@every_model
def test_neighbours_fade_out_at_the_cutoff(choices):
    force, (position, velocity, density) = model(**choices), state(3)
    position = torch.full((3, 3), 1.0, dtype=torch.float64)
    position[1, 0] += 0.4
    alone = rates(force, position[:2], velocity[:2], density[:2])
    # Beyond the cutoff: matrix products of another width round otherwise.
    for distance, most in ((1.0001, 1e-15), (0.99999, 1e-6), (0.7, torch.inf)):
        position[2, 0] = 1.0 - CUTOFF * distance
        with_third = rates(force, position, velocity, density, cutoff=1.1 * CUTOFF)
        assert max((with_third[name][:2] - alone[name]).abs().max().item() for name in alone) <= most


DEGENERATE = {
    "coincident": lambda: (cloud("coincident", 5), *state(5)[1:]),
    "equal velocities": lambda: (cloud(count=50), torch.ones(50, 3, dtype=torch.float64), state(50)[2]),
    "equal densities": lambda: (*state(50)[:2], torch.ones(50, dtype=torch.float64)),
    "alone": lambda: state(1),
    "a pair": lambda: (torch.tensor([[1.0, 1, 1], [1.2, 1, 1]], dtype=torch.float64), *state(2)[1:]),
    "coplanar": lambda: (cloud(count=30) * torch.tensor([1, 1, 0]), *state(30)[1:]),
    "all the same": lambda: tuple(column[:1].expand(4, *column.shape[1:]).clone() for column in state(4)),
}


@every_model
@pytest.mark.parametrize("case", DEGENERATE)
def test_degenerate_states_have_finite_rates_and_gradients(choices, case):
    force = model(**choices)
    particles = [column.clone().requires_grad_() for column in DEGENERATE[case]()]
    result = rates(force, *particles)
    sum((rate**2).sum() for rate in result.values()).backward()
    assert all(torch.isfinite(rate).all() for rate in result.values())
    gradients = [tensor.grad for tensor in (*particles, *force.parameters())]
    assert all(gradient is None or torch.isfinite(gradient).all() for gradient in gradients)
    if case == "alone":
        assert all((rate == 0).all() for rate in result.values())


@every_model
def test_gradient_against_finite_differences(choices):
    force, particles = model(**choices), [column.requires_grad_() for column in state(12)]
    # The factors of the resolved stress are the closure's, and no part of the sum over pairs.
    parameters = [parameter for name, parameter in force.named_parameters() if name != "force_factors"]

    def along(direction, step):
        with torch.no_grad():
            moved = [x + step * d for x, d in zip((*particles, *parameters), direction)]
            saved = [parameter.clone() for parameter in parameters]
            for parameter, value in zip(parameters, moved[3:]):
                parameter.copy_(value)
            total = sum((rate**2).sum() for rate in rates(force, *moved[:3]).values())
            for parameter, value in zip(parameters, saved):
                parameter.copy_(value)
        return total

    generator = torch.manual_seed(6)
    direction = [torch.randn(x.shape, dtype=x.dtype, generator=generator) for x in (*particles, *parameters)]
    direction[2] = direction[2] * SCALES.density
    total = sum((rate**2).sum() for rate in rates(force, *particles).values())
    gradients = torch.autograd.grad(total, (*particles, *parameters))
    expected = sum((gradient * d).sum() for gradient, d in zip(gradients, direction)).item()
    step = 1e-5
    difference = (along(direction, step) - along(direction, -step)).item() / (2 * step)
    assert difference == pytest.approx(expected, rel=1e-6)


def test_without_a_basis_there_is_no_pair_sum_and_nothing_but_the_closure_s_factors():
    alone = model(basis="none", closure="poisson-stress")
    assert alone.pair_terms == [] and list(alone.state_dict()) == ["force_factors"]
    assert PairModel.from_description(alone.state_description()).pair_terms == []
    for choices in (dict(closure="poisson-force"), dict(closure="poisson-stress", eddy_viscosity="two-sided")):
        with pytest.raises(ValueError, match='basis "none" goes with closure "poisson-stress"'):
            model(basis="none", **choices)


@every_model
def test_description_and_weights_make_the_same_model(choices):
    force, particles = model(**choices, seed=9), state()
    description = json.loads(json.dumps(force.state_description()))
    again = PairModel.from_description(description)
    again.load_state_dict(force.state_dict())
    assert_same(rates(again, *particles), rates(force, *particles), tolerance=0)


def test_single_precision_agrees_with_double():
    double, single, particles = model(), model().float(), state()
    from_double = rates(double, *particles)["velocity"]
    from_single = rates(single, *particles, dtype=torch.float32)["velocity"]
    assert from_single.dtype == torch.float32
    assert (from_single - from_double).norm() < 1e-5 * from_double.norm()


def test_density_rate_only_where_it_is_learned():
    particles = state()
    assert set(rates(model(closure="poisson"), *particles)) == {"velocity"}
    for closure in ("learned-density", "paper-density"):
        assert set(rates(model(closure=closure), *particles)) == {"velocity", "density"}


def test_absent_parts_have_no_parameters():
    names = {name.split(".")[0] for name, _ in model(basis="paper").named_parameters()}
    assert names == {"network"}


def test_corrected_push_of_a_linear_profile_is_its_gradient():
    """With NN_1 replaced by a linear function of place, M^-1 sum w NN_1 x is that function's gradient."""
    x = torch.randn(3, 40, dtype=torch.float64, generator=torch.manual_seed(2))
    w = torch.rand(40, dtype=torch.float64)
    slope = torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    moment = torch.stack(moments.products(w * x, x)).sum(1, keepdim=True)
    push = (w * (slope @ x) * x).sum(1, keepdim=True)
    assert torch.allclose(moments.apply_symmetric(moments.invert_symmetric(moment), push)[:, 0], slope)


def test_learned_density_of_a_uniform_expansion():
    """Without network flux, as a model starts, d rho/dt = -a rho_0 div v: here div v = 3 x 0.2, a = 1."""
    force = model(closure="learned-density")
    with torch.no_grad():
        force.density_factors[0] = 1.0
    middle = torch.tensor([[LENGTH / 2] * 3], dtype=torch.float64)
    position = torch.cat([middle, middle + 0.3 * (cloud(count=60) - LENGTH / 2)])
    velocity, density = 0.2 * (position - middle), torch.ones(61, dtype=torch.float64)
    rate = rates(force, position, velocity, density)["density"]
    assert rate[0].item() == pytest.approx(-0.6, rel=2e-3)


def test_two_sided_and_one_sided_eddy_viscosity():
    position = torch.tensor([[1.0, 1, 1], [1.5, 1, 1]], dtype=torch.float64)
    density = torch.ones(2, dtype=torch.float64)
    apart = torch.tensor([[-1.0, 0, 0], [1.0, 0, 0]], dtype=torch.float64)
    for velocity, monaghan_acts in ((apart, False), (-apart, True)):
        without = rates(model(basis="paper"), position, velocity, density)["velocity"]
        for form in ("two-sided", "monaghan"):
            added = rates(model(basis="paper", eddy_viscosity=form), position, velocity, density)["velocity"]
            acts = bool((added - without).abs().max() > 1e-6)
            assert acts == (monaghan_acts or form == "two-sided")
            if monaghan_acts:
                # Approaching particles are pushed apart.
                assert (added - without)[0, 0] < 0


antisymmetric = pytest.mark.parametrize("choices", ANTISYMMETRIC, ids=lambda choices: choices["closure"])


@antisymmetric
def test_antisymmetric_forces_of_a_pair_are_opposite_to_the_last_bit(choices):
    force, alike = model(**choices), model(**{**choices, "symmetry": "none"})
    for seed in range(5):
        position, velocity, density = state(2, seed)
        position[1] = position[0] + 0.5 * torch.randn(3, dtype=torch.float64, generator=torch.manual_seed(seed))
        first, second = rates(force, position, velocity, density)["velocity"]
        assert torch.equal(first, -second) and first.norm() > 1e-3
        first, second = rates(alike, position, velocity, density)["velocity"]
        assert (first + second).norm() > 1e-6


@antisymmetric
def test_one_evaluation_of_a_pair_serves_both_particles(choices):
    """All pairs in both orders, and each pair once with its values times their parity for the other one."""
    force, (position, velocity, density) = model(**choices), state()
    columns, listed = {"velocity": velocity, "density": density}, NeighborList(PeriodicBox(LENGTH), CUTOFF, 0.0)
    listed.build(position, position, exclude_self=True)
    both, once = (listed.pairs(position, position, once=each) for each in (False, True))
    assert 2 * len(once.sender) == len(both.sender)
    sums = torch.zeros(len(force.parity), 200, dtype=torch.float64)
    once.add_to_both(force.pair_values(once, columns), force.parity.double(), sums)
    assert_same(force.rates(sums), force(both, columns), 1e-12)


def test_opposite_forces_do_not_go_with_moment_matrices():
    with pytest.raises(ValueError, match='does not go with basis "corrected"'):
        model(symmetry="antisymmetric")


@pytest.mark.parametrize("choice", ["basis", "closure", "eddy_viscosity", "symmetry"])
def test_unknown_choices_are_refused(choice):
    with pytest.raises(ValueError, match="one of"):
        model(**{choice: "other"})
