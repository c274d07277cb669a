"""A model is a list of terms: what it reads and gives, what it keeps of linear terms, what it refuses."""

import json
from dataclasses import asdict, dataclass, replace

import numpy as np
import pytest
import torch

from eddies.import_path import ImportPathError
from eddies.parallel.reduction import sum_flat
from eddies.particles import context as context_module
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.rates import Rates, total
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import PRESETS, TERMS, TermError, TermSettings
from tests.particles.configurations import (
    FLOW, MODELS, DensityReader, Field, ReadsNothing, distributed, dynamics_of, given, model, of_terms, state,
)


def randomised(lagrangian, seed=3):
    """With random parameters."""
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in lagrangian.parameters():
            parameter.copy_(torch.randn(parameter.shape, dtype=torch.float64, generator=generator))
    return lagrangian


LINEAR = ["pressure", "stress", "damping", "relaxation", "injection", "viscosity"]
SETTINGS = {"injection": dict(injection_rate=0.3)}


def test_which_terms_are_linear():
    terms = model({word: SETTINGS.get(word, {}) for word in (*LINEAR, "pairs", "continuity", "density-flux",
                                                             "eddy-viscosity", "wcsph", "transport-velocity")}).terms
    assert {word for word, term in terms.items() if term.linear} == set(LINEAR)


def assert_same_rates(found, expected, tolerance=1e-12):
    found, expected = given(found), given(expected)
    assert found.keys() == expected.keys()
    for name, values in expected.items():
        assert (found[name] - values).abs().max() <= tolerance * max(float(values.detach().abs().max()), 1e-300), name


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("word", LINEAR)
def test_what_is_kept_of_a_linear_term_is_what_it_gives(comm, word):
    """At other parameters than those at which it was kept, for all particles and for some rows."""
    slab, particles = distributed(comm, *state())
    lagrangian = LagrangianModel({**model({word: SETTINGS.get(word, {})}).terms, "reader": DensityReader()}, FLOW)
    dynamics = dynamics_of(slab, lagrangian)
    kept = lagrangian.linear_rates(dynamics.context(particles))
    assert set(kept) == {word}
    for seed in (1, 2):
        randomised(lagrangian, seed)
        for rows in (None, torch.tensor([7, 3, 3, 12])):
            direct = dynamics.rates(particles, rows)
            assert_same_rates(dynamics.rates(particles, rows, kept), direct)
            assert len(direct.acceleration) == (len(particles) if rows is None else 4)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", ["resolved + pairs", "told densities", "pressure", "resolved"])
def test_rates_and_gradients_with_what_is_kept_are_those_without(comm, name):
    slab, particles = distributed(comm, *state())
    lagrangian = model({**MODELS[name], **SETTINGS})
    dynamics = dynamics_of(slab, lagrangian)
    kept = lagrangian.linear_rates(dynamics.context(particles))
    assert set(kept) == set(lagrangian.terms) - {"pairs"}
    randomised(lagrangian)
    rows, found = torch.tensor([2, 31, 5]), []
    density = dynamics.rates(particles, kept=kept).density
    for chosen in ({}, {"kept": kept}):
        rates = dynamics.rates(particles, rows, **chosen)
        loss = rates.acceleration.square().sum() + (0 if rates.density is None else 100 * rates.density.sum())
        parameters = list(lagrangian.parameters())
        gradients = [part.numpy().copy() for part in torch.autograd.grad(loss, parameters, materialize_grads=True)]
        sum_flat(comm, gradients)
        found.append((rates, gradients))
    assert_same_rates(found[1][0], found[0][0])
    for name, kept_gradient, gradient in zip(dict(lagrangian.named_parameters()), found[1][1], found[0][1]):
        assert np.abs(kept_gradient - gradient).max() <= 1e-11 * max(np.abs(gradient).max(), 1e-10), name
    if density is not None:  # as training does, which takes the density once
        again = dynamics.rates(particles, rows, kept, density.detach())
        assert_same_rates(again, found[0][0])


@pytest.mark.mpi(1, 2)
def test_what_is_kept_makes_no_message(comm, monkeypatch):
    """Neither grid nor sums over ranks are there when only kept terms are evaluated."""
    slab, particles = distributed(comm, *state())
    lagrangian = model(PRESETS["resolved"])
    dynamics = dynamics_of(slab, lagrangian)
    context = dynamics.context(particles)
    kept = lagrangian.linear_rates(context)
    expected = dynamics.rates(particles)
    for name in ("resolved", "local"):
        monkeypatch.setattr(context_module.Context, name, property(lambda context: pytest.fail("is not needed")))
    assert_same_rates(lagrangian.rates(dynamics.context(particles), kept), expected)


class LinearPairs(PairTerm):
    """A pair term of a user's that is linear: its factor stands within the sum."""

    @dataclass(frozen=True, kw_only=True)
    class Settings(TermSettings):
        reads = ("pairs",)

    parity, linear = -torch.ones(3), True

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.factor = torch.nn.Parameter(torch.ones(()))

    def pair_values(self, pairs):
        return self.factor * pairs.weight * pairs.v

    def rates_of(self, sums, context):
        return Rates(acceleration=sums.T)


@pytest.mark.mpi(1)
def test_a_linear_sum_over_pairs_is_kept_too(comm):
    slab, particles = distributed(comm, *state())
    lagrangian = build_model({"LinearPairs": LinearPairs.Settings()}, [f"{__name__}:LinearPairs"], FLOW)
    dynamics = dynamics_of(slab, lagrangian)
    kept = lagrangian.linear_rates(dynamics.context(particles))
    randomised(lagrangian)
    for rows in (None, torch.tensor([4, 1])):
        expected = dynamics.rates(particles, rows)
        assert expected.acceleration.abs().max() > 0
        assert_same_rates(dynamics.rates(particles, rows, kept), expected)


@pytest.mark.mpi(1, 2)
def test_the_modes_of_a_force_stand_beside_the_acceleration_that_they_make(comm):
    """Less the mean over particles; also beside terms that read the density, and where some rows alone are asked."""
    slab, particles = distributed(comm, *state())
    forces = model(MODELS["resolved"]).terms
    lagrangian = LagrangianModel({name: forces[name] for name in forces if name != "relaxation"}, FLOW)
    dynamics = dynamics_of(slab, lagrangian, iterations=5)
    context = dynamics.context(particles)
    rates = lagrangian.rates(context)
    expected = context.without_mean(context.resolved.at_particles(rates.force_modes))
    assert rates.acceleration.abs().max() > 0.1 and torch.allclose(rates.acceleration, expected, atol=1e-13)
    pairs = model(pairs={}).terms
    both = dynamics_of(slab, LagrangianModel({**pairs, **lagrangian.terms}, FLOW), iterations=5).rates(particles)
    assert torch.allclose(both.force_modes, rates.force_modes, atol=1e-13)
    some = dynamics.rates(particles, torch.tensor([3, 1]))
    assert len(some.acceleration) == 2 and torch.equal(some.force_modes, rates.force_modes)
    assert dynamics_of(slab, model(pairs={})).rates(particles).force_modes is None


# ---- the list


def test_what_a_model_reads_and_gives_is_what_its_terms_do():
    assert model().reads == model().gives == set() and not model().reads_density
    given, learned, resolved = (model(MODELS[name]) for name in ("pressure", "corrected", "resolved"))
    assert given.reads == {"pairs", "resolved", "density"} and learned.reads == {"pairs", "density"}
    assert given.density_is_given and not learned.density_is_given
    # The pressure gives a density, but nobody reads it.
    assert "density" in resolved.gives and not resolved.reads_density and not resolved.density_is_given
    assert [len(each.networks) for each in (given, learned, resolved)] == [1, 2, 0]


@pytest.mark.mpi(1)
@pytest.mark.parametrize("word", TERMS)
def test_every_parameter_is_told_as_a_coefficient(comm, word):
    """Each term tells as many numbers as it learns, those of a network by their count, and none below zero where the
    size alone counts."""
    settings = {"diffusion": 0.1} if word == "continuity" else {}
    found = model({word: settings})
    with torch.no_grad():
        for parameter in found.parameters():
            parameter.neg_()
    told = found.learned_coefficients.get(word, [])
    count = sum(each["learned"] if each["name"] == "weights" else np.size(each["learned"]) for each in told)
    assert count == sum(parameter.numel() for parameter in found.parameters())
    assert all(each["unit"] and each["meaning"] for each in told)
    assert all(each["learned"] >= 0 and each["value"] >= 0 for each in told if each["name"].startswith("|"))
    assert json.loads(json.dumps(told)) == told


@pytest.mark.mpi(1)
def test_settings_and_weights_make_the_same_model(comm):
    slab, particles = distributed(comm, *state())
    for name, terms in MODELS.items():
        lagrangian = randomised(model(terms))
        again = model({name: asdict(term.settings) for name, term in lagrangian.terms.items()})
        again.load_state_dict(lagrangian.state_dict())
        assert_same_rates(dynamics_of(slab, again).rates(particles), dynamics_of(slab, lagrangian).rates(particles), 0)


def test_absent_terms_have_no_parameters():
    assert list(model(PRESETS["resolved"]).state_dict()) == ["terms.damping.rates", "terms.relaxation.factor"]
    assert list(model(pressure={}, stress={}).parameters()) == []


@pytest.mark.mpi(1)
def test_without_terms_particles_move_straight_on(comm):
    slab, particles = distributed(comm, *state())
    for rows, count in ((None, 200), (torch.tensor([1, 2]), 2)):
        rates = given(dynamics_of(slab, model()).rates(particles, rows))
        assert set(rates) == {"acceleration"} and torch.equal(rates["acceleration"], torch.zeros(count, 3).double())


@dataclass(frozen=True, kw_only=True)
class Both(TermSettings):
    """Settings of a term that reads the density and gives a part of it."""

    reads = gives = ("density",)


def test_a_term_cannot_read_the_density_and_give_it():
    with pytest.raises(TermError, match="reads the density and gives a part of it"):
        of_terms(Term(Both(), FLOW))


class NotRates(Field):
    """Returns a tensor."""

    def forward(self, context):
        return context.particles.velocity


@pytest.mark.mpi(1)
def test_a_term_that_does_not_return_rates_is_named(comm):
    slab, particles = distributed(comm, *state())
    with pytest.raises(TermError, match="NotRates: forward returns a Tensor"):
        dynamics_of(slab, of_terms(NotRates(None))).rates(particles)
    with pytest.raises(NotImplementedError, match="Term has no forward"):
        dynamics_of(slab, of_terms(Term(ReadsNothing(), FLOW))).rates(particles)


class NoTerm:
    """Not derived from Term."""


class NeedsMore(Term):
    """Cannot be made as terms are."""

    def __init__(self, settings, flow, more):
        super().__init__(settings, flow)


@pytest.mark.parametrize("name, settings, kind, complaint", [
    ("NoTerm", ReadsNothing(), TermError, "must be a class derived from eddies.Term"),
    ("Nothing", ReadsNothing(), ImportPathError, "has no Nothing"),
    ("NeedsMore", ReadsNothing(), TermError, "cannot be made"),
    ("Term", object(), TermError, "frozen dataclass derived from eddies.TermSettings"),
])
def test_what_cannot_be_a_term_gets_one_clear_error(name, settings, kind, complaint):
    with pytest.raises(kind, match=complaint):
        build_model({name: settings}, [f"{__name__}:{name}"], FLOW)


# ---- sums of contributions


def test_contributions_add_up_and_what_none_gives_is_absent():
    one, two = torch.ones(3, 3), torch.full((3, 3), 2.0)
    summed = total([Rates(acceleration=one), Rates(density=one[0]), Rates(), Rates(acceleration=two)])
    assert set(given(summed)) == {"acceleration", "density"}
    assert torch.equal(summed.acceleration, one + two) and torch.equal(summed.density, one[0])
    assert given(total([])) == {}


def test_rows_are_of_accelerations_and_rates_alone():
    rates = Rates(torch.arange(12.0).reshape(4, 3), torch.arange(4.0), torch.arange(4.0), torch.ones(3, 2, 2, 2))
    some = rates.at(torch.tensor([2, 0]))
    assert some.acceleration.tolist() == [[6, 7, 8], [0, 1, 2]] and some.density_rate.tolist() == [2, 0]
    assert torch.equal(some.density, rates.density) and some.force_modes is rates.force_modes
    assert rates.at(None) is rates and replace(rates, density_rate=None).at(torch.tensor([1])).density_rate is None
