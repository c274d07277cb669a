"""Quantities that terms use are computed at first use and shared; unused ones are not computed."""

import gc
import weakref

import pytest
import torch

from eddies.particles import context as context_module
from eddies.particles.rates import Rates
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.terms.term import PairTerm
from eddies.scene.terms import PRESETS, TermError
from tests.particles.configurations import (
    FLOW, MODELS, Given, alone, declared, distributed, dynamics_of, model, of_terms, state,
)


def count_calls(monkeypatch, owner, name):
    """List that grows with each call of a method."""
    calls, method = [], getattr(owner, name)

    def counted(*arguments, **named):
        calls.append(name)
        return method(*arguments, **named)

    monkeypatch.setattr(owner, name, counted)
    return calls


@pytest.mark.mpi(2)
def test_terms_share_pairs_and_the_resolved_velocity(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model({**MODELS["resolved + pairs"], "eddy-viscosity": {}, "density-flux": {}}))
    dynamics.rates(particles)
    sums = count_calls(monkeypatch, context_module.Context, "_compiled_sums")
    solves = count_calls(monkeypatch, ResolvedVelocity, "of")
    with torch.no_grad():
        dynamics.rates(particles, torch.arange(3))
    assert len(solves) == 1 and len(sums) == 2  # pairs before the density is known, and after


@pytest.mark.mpi(1)
@pytest.mark.parametrize("terms", [MODELS["published"], MODELS["pairs with density"], PRESETS["local"]])
def test_an_evaluation_leaves_no_reference_cycle(comm, monkeypatch, terms):
    """Lists and weights are most of a run's memory: it must be free without garbage collection."""
    slab, particles = distributed(comm, *state())
    dynamics, made = dynamics_of(slab, model(terms)), []
    make = dynamics.context

    def recording(*given, **named):
        context = make(*given, **named)
        made.append(weakref.ref(context))
        return context

    monkeypatch.setattr(dynamics, "context", recording)
    gc.collect()
    gc.disable()
    try:
        with torch.no_grad():
            dynamics.rates(particles)
        assert len(made) == 1 and made[0]() is None
    finally:
        gc.enable()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("used, reads, missing", [
    (lambda context: context.local.position, (), "pairs"),
    (lambda context: context.column("velocity"), (), "pairs"),
    (lambda context: context.column("density"), ("pairs",), "density"),
    (lambda context: context.resolved.missing(), ("pairs",), "resolved")])
def test_an_undeclared_input_is_named(comm, used, reads, missing):
    slab, particles = alone(*state()[:2])
    with pytest.raises(TermError, match=f'"{missing}".*`reads`'):
        dynamics_of(slab, of_terms(Given(used, reads))).rates(particles)


class WeightedMean(PairTerm):
    """A density from a sum over pairs and the moments of the neighbourhoods."""

    needs_moments = True

    def pair_values(self, pairs):
        return (pairs.weight * pairs.distance).unsqueeze(0)

    def rates_of(self, sums, context):
        return Rates(density=(sums / context.moments.weight)[0])


@pytest.mark.mpi(2)
def test_a_density_is_summed_for_all_particles_if_rates_are_for_some(comm):
    """Density and rates of some particles both need moments."""
    slab, particles = distributed(comm, *state())
    giving = WeightedMean(declared(("pairs",), ("density",)), FLOW).double()
    lagrangian = of_terms(giving, *model(pairs={}, eddy_viscosity={}).terms.values())
    rows = torch.arange(0, len(particles), 3)
    whole = dynamics_of(slab, lagrangian).rates(particles)
    some = dynamics_of(slab, lagrangian).rates(particles, rows)
    assert torch.allclose(some.density, whole.density, atol=1e-14)
    assert torch.allclose(some.acceleration, whole.acceleration[rows], rtol=1e-12, atol=1e-14)
