"""A model is a list of terms: inputs, contributions, stored linear terms, and errors."""

import json
import sys

import numpy as np
import pytest
import torch

from eddies.import_path import ImportPathError
from eddies.parallel.reduction import sum_flat
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_network import build_network, outputs_of
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import TERMS, PairNetwork, TermError
from tests.particles.configurations import (
    FLOW, MODELS, PAIR_MODELS, Given, declared, distributed, dynamics_of, given, model, of_terms, state,
)


def randomised(lagrangian, seed=3):
    """The model with random parameters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in lagrangian.parameters():
            parameter.copy_(torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    return lagrangian


LINEAR = ["pressure", "stress", "damping", "relaxation", "injection", "viscosity"]
SETTINGS = {"injection": dict(injection_rate=0.3)}


def assert_same_rates(actual, expected):
    actual, expected = given(actual), given(expected)
    assert actual.keys() == expected.keys()
    for name, values in expected.items():
        assert (actual[name] - values).abs().max() <= 1e-12 * max(float(values.detach().abs().max()), 1e-300), name


class LinearPairs(PairTerm):
    """A user's linear sum over pairs: the parameter is within the sum."""

    parity, linear = -torch.ones(3), True

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.factor = torch.nn.Parameter(torch.ones(()))

    def pair_values(self, pairs):
        return self.factor * pairs.weight * pairs.v

    def rates_of(self, sums, context):
        return Rates(acceleration=sums.T)


@pytest.mark.mpi(2)
def test_stored_linear_terms_give_their_rates_and_gradients_at_any_parameters(comm):
    """For all particles and for some rows, with a user's sum over pairs and a network that reads the density."""
    slab, particles = distributed(comm, *state())
    linear = model({word: SETTINGS.get(word, {}) for word in LINEAR})
    pairs = build_model({"LinearPairs": declared(("pairs",))}, [f"{__name__}:LinearPairs"], FLOW)
    lagrangian = LagrangianModel({**linear.terms, **pairs.terms, **model(pairs={}).terms}, FLOW)
    dynamics = dynamics_of(slab, lagrangian)
    kept = lagrangian.linear_rates(dynamics.context(particles))
    assert set(kept) == {*LINEAR, "LinearPairs"}
    for seed, rows in ((1, None), (2, torch.tensor([7, 3, 3, 12]))):
        randomised(lagrangian, seed)
        results = []
        for chosen in ({}, {"kept": kept}):
            rates = dynamics.rates(particles, rows, **chosen)
            loss = rates.acceleration.square().sum() + 100 * rates.density.sum()
            gradients = torch.autograd.grad(loss, list(lagrangian.parameters()), materialize_grads=True)
            gradients = [part.numpy().copy() for part in gradients]
            sum_flat(comm, gradients)
            results.append((rates, gradients))
        (direct, expected), (stored, gradients) = results
        assert_same_rates(stored, direct)
        for gradient, reference in zip(gradients, expected):
            assert np.abs(gradient - reference).max() <= 1e-11 * max(np.abs(reference).max(), 1e-10)
    # Training computes the density once.
    assert_same_rates(dynamics.rates(particles, rows, kept, stored.density.detach()), direct)


class Quadratic(Term):
    """Declares itself linear in its parameter, and is not."""

    linear = True

    def __init__(self):
        super().__init__(declared(), FLOW)
        self.factor = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context):
        return Rates(acceleration=self.factor**2 * context.particles.velocity)


@pytest.mark.mpi(2)
def test_a_term_that_is_not_linear_is_named(comm):
    slab, particles = distributed(comm, *state())
    linear, quadratic = model(damping={}, relaxation={}), of_terms(Quadratic())
    linear.require_linear(dynamics_of(slab, linear).context(particles))
    with pytest.raises(TermError, match="Quadratic.*linear"):
        quadratic.require_linear(dynamics_of(slab, quadratic).context(particles))


@pytest.mark.mpi(2)
def test_the_modes_of_a_force_are_those_of_its_acceleration(comm):
    """At the particles; also beside terms that read the density, and for some rows."""
    slab, particles = distributed(comm, *state())
    forces = model({word: settings for word, settings in MODELS["resolved"].items() if word != "relaxation"}).terms
    lagrangian = LagrangianModel(forces, FLOW)
    dynamics = dynamics_of(slab, lagrangian, iterations=5)
    context = dynamics.context(particles)
    rates = lagrangian.rates(context)
    expected = context.resolved.at_particles(rates.force_modes)
    assert rates.acceleration.abs().max() > 0.1 and torch.allclose(rates.acceleration, expected, atol=1e-13)
    pairs = model(pairs={}).terms
    both = dynamics_of(slab, LagrangianModel({**pairs, **forces}, FLOW), iterations=5).rates(particles)
    assert torch.allclose(both.force_modes, rates.force_modes, atol=1e-13)
    some = dynamics.rates(particles, torch.tensor([3, 1]))
    assert len(some.acceleration) == 2 and torch.equal(some.force_modes, rates.force_modes)


def test_inputs_and_contributions_of_a_model_are_those_of_its_terms():
    assert model().reads == model().gives == set() and not model().reads_density
    giving, learned, resolved = (model(MODELS[name]) for name in ("pressure", "corrected", "resolved"))
    assert giving.reads == {"pairs", "resolved", "density"} and learned.reads == {"pairs", "density"}
    assert giving.density_is_given and not learned.density_is_given
    # The pressure gives a density that no term reads.
    assert "density" in resolved.gives and not resolved.reads_density and not resolved.density_is_given
    assert [len(each.networks) for each in (giving, learned, resolved)] == [1, 2, 0]
    # A density rate is fitted to single moments, unless a term learns it through several steps.
    fitted = [model(PAIR_MODELS[name]).regresses_density for name in ("paper", "corrected", "pairs")]
    assert fitted == [True, False, False]
    assert list(resolved.state_dict()) == ["terms.damping.rates", "terms.relaxation.factor"]


@pytest.mark.parametrize("word", TERMS)
def test_every_parameter_is_reported_as_a_coefficient(word):
    """A network reports its number of weights. A coefficient whose magnitude counts is not negative."""
    lagrangian = model({word: {"diffusion": 0.1} if word == "continuity" else {}})
    with torch.no_grad():
        for parameter in lagrangian.parameters():
            parameter.neg_()
    reported = lagrangian.learned_coefficients.get(word, [])
    count = sum(each["learned"] if each["name"] == "weights" else np.size(each["learned"]) for each in reported)
    assert count == sum(parameter.numel() for parameter in lagrangian.parameters())
    assert all(each["unit"] and each["meaning"] for each in reported)
    assert all(each["learned"] >= 0 and each["value"] >= 0 for each in reported if each["name"].startswith("|"))
    assert json.loads(json.dumps(reported)) == reported


@pytest.mark.mpi(1)
def test_a_term_that_contradicts_its_declaration_is_named(comm):
    slab, particles = distributed(comm, *state())
    with pytest.raises(TermError, match="density"):
        of_terms(Given(None, reads=("density",), gives=("density",)))
    velocity, count = particles.velocity, len(particles)
    for function, gives, complaint in (
            (lambda context: velocity, ("acceleration",), "returns a tensor of shape .*must return Rates"),
            (lambda context: Rates(), ("density",), "and returns none"),
            (lambda context: Rates(acceleration=velocity[:, 0]), ("acceleration",), rf"must be .*\({count}, 3\)"),
            (lambda context: Rates(density_rate=velocity), ("density_rate",), rf"must be a real .*\({count},\)"),
            (lambda context: Rates(acceleration=velocity + 0j), ("acceleration",), "complex128; it must be a real"),
            (lambda context: Rates(acceleration=velocity.numpy()), ("acceleration",), "a ndarray; it must be"),
            (lambda context: Rates(density_rate=velocity[:, 0]), ("acceleration",), 'add "density_rate" to `gives`'),
            (lambda context: Rates(acceleration=velocity[count]), ("acceleration",),
             r"configurations.py, line \d+: IndexError: index"),
            (lambda context: sys.exit(4), ("acceleration",), r"line \d+: SystemExit: 4")):
        with pytest.raises(TermError, match=f"Given: .*{complaint}"):
            dynamics_of(slab, of_terms(Given(function, gives=gives))).rates(particles)
    with pytest.raises(TermError, match=r"Term: has no forward\(context\)"):
        dynamics_of(slab, of_terms(Term(declared(), FLOW))).rates(particles)
    for values in (lambda pairs: pairs.distance, lambda pairs: pairs.x.T, lambda pairs: None):
        with pytest.raises(TermError, match="AnyPairs: pair_values returns .*a column for each pair"):
            dynamics_of(slab, of_terms(AnyPairs(values))).rates(particles)
    network = build_network(PairNetwork(network=f"{__name__}:Narrow"), 2, 0)
    with pytest.raises(TermError, match=r"Narrow: returns a tensor of shape \(1, 5\).*must return .* \(2, 5\)"):
        outputs_of(network, torch.zeros(5, 5), 2)


class AnyPairs(PairTerm):
    """A sum of a function of pairs."""

    def __init__(self, values):
        super().__init__(declared(("pairs",)), FLOW)
        self.pair_values = values


class Narrow(torch.nn.Module):
    """A network with one output."""

    def __init__(self, inputs, hidden, outputs, seed):
        super().__init__()

    def forward(self, features):
        return features[:1]


class Learned(Term):
    """A term with one parameter, whose acceleration is a function of context and parameter."""

    def __init__(self, acceleration):
        super().__init__(declared(), FLOW)
        self.factor, self.acceleration = torch.nn.Parameter(torch.ones((), dtype=torch.float64)), acceleration

    def forward(self, context):
        return Rates(acceleration=self.acceleration(context, self.factor))


@pytest.mark.mpi(2)
def test_a_fault_that_shapes_do_not_show_is_found_before_training(comm):
    slab, particles = distributed(comm, *state())
    before = particles.velocity.clone()
    for acceleration, complaint in (
            (lambda context, factor: factor * context.particles.velocity, None),
            (lambda context, factor: context.particles.velocity.clamp_(-0.1, 0.1), "in place; work on a copy"),
            (lambda context, factor: factor * context.particles.velocity / 0.0, "not finite with the initial"),
            (lambda context, factor: factor.detach() * context.particles.velocity, "on the parameter factor, so it")):
        lagrangian = LagrangianModel({"own": Learned(acceleration)}, FLOW)
        context = dynamics_of(slab, lagrangian).context(particles)
        if complaint is None:
            lagrangian.check_terms(context)
        else:
            with pytest.raises(TermError, match=f'term "own": .*{complaint}'):
                lagrangian.check_terms(context)
        particles.velocity.copy_(before)


class NoTerm:
    """Not derived from Term."""


class NeedsMore(Term):
    """Its constructor takes other arguments."""

    def __init__(self, settings, flow, more):
        super().__init__(settings, flow)


@pytest.mark.parametrize("name, settings, kind, complaint", [
    ("NoTerm", declared(), TermError, "derived from eddies.Term"),
    ("Nothing", declared(), ImportPathError, "Nothing"),
    ("NeedsMore", declared(), TermError, "NeedsMore.*cannot be made"),
    ("Term", object(), TermError, "eddies.TermSettings"),
])
def test_a_class_that_cannot_be_a_term_is_refused(name, settings, kind, complaint):
    with pytest.raises(kind, match=complaint):
        build_model({name: settings}, [f"{__name__}:{name}"], FLOW)
