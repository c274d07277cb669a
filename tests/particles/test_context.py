"""What terms ask for is built at first use and shared; what none asks for is not built."""

import gc
import weakref
from dataclasses import dataclass

import pytest
import torch

from eddies.parallel.halo import HaloExchange
from eddies.particles import context as context_module
from eddies.particles import moments
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.rates import Rates
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import PRESETS, TermError, TermSettings
from tests.particles.configurations import (
    CUTOFF, MODELS, NEIGHBORS, SCALES, ReadsNothing, alone, distributed, dynamics_of, model, of_terms, state,
)


class Counted:
    """Counts calls of methods of a class while a test runs."""

    def __init__(self, monkeypatch, owner, *names):
        self.calls = {name: 0 for name in names}
        for name in names:
            monkeypatch.setattr(owner, name, self._counting(name, getattr(owner, name)))

    def _counting(self, name, method):
        def counted(*arguments, **named):
            self.calls[name] += 1
            return method(*arguments, **named)

        return counted


@pytest.mark.mpi(1, 2)
def test_terms_share_pairs_columns_and_the_resolved_velocity(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    terms = {**MODELS["resolved + pairs"], "eddy-viscosity": {}, "density-flux": {}}
    dynamics = dynamics_of(slab, model(terms))
    dynamics.rates(particles)
    pairs = Counted(monkeypatch, context_module.Context, "_compiled_sums", "_sums_of")
    resolved = Counted(monkeypatch, ResolvedVelocity, "of")
    with torch.no_grad():
        dynamics.rates(particles, torch.arange(3))
    # Pairs before the density is known, and after.
    assert resolved.calls["of"] == 1 and sum(pairs.calls.values()) == 2


@pytest.mark.mpi(1)
@pytest.mark.parametrize("terms", [*MODELS.values(), PRESETS["local"]], ids=[*MODELS, "local"])
def test_an_evaluation_leaves_nothing_behind(comm, monkeypatch, terms):
    """Lists and weights are most of a run's memory: none waits for a collector."""
    slab, particles = distributed(comm, *state())
    dynamics, made = dynamics_of(slab, model(terms)), []
    make = dynamics.context
    monkeypatch.setattr(dynamics, "context", lambda *given, **named: keep(make(*given, **named)))

    def keep(context):
        made.append(weakref.ref(context))
        return context

    gc.collect()
    gc.disable()
    try:
        with torch.no_grad():
            dynamics.rates(particles)
        assert len(made) == 1 and made[0]() is None
    finally:
        gc.enable()


@pytest.mark.mpi(1, 2)
def test_a_model_without_pairs_sees_none_but_its_own_particles(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS["resolved"]))
    halo, lists = Counted(monkeypatch, HaloExchange, "__init__"), Counted(monkeypatch, NeighborList, "__init__")
    dynamics.rates(dynamics.settle(particles)[0])
    assert dynamics.neighborhood is None and halo.calls == lists.calls == {"__init__": 0}
    both = dynamics_of(slab, model(MODELS["resolved + pairs"]))
    both.rates(particles)
    assert both.neighborhood.cutoff == both.neighborhood.neighbors.cutoff == CUTOFF
    assert halo.calls == lists.calls == {"__init__": 1}


class Asking(Term):
    """Asks for what it does not declare."""

    Settings = ReadsNothing

    def __init__(self, name, settings=None):
        super().__init__(settings or ReadsNothing(), of_terms().flow)
        self.name = name

    def forward(self, context):
        if self.name == "resolved":
            return Rates(acceleration=context.resolved.missing())
        return Rates(acceleration=context.local.position if self.name == "pairs" else context.column(self.name))


@dataclass(frozen=True, kw_only=True)
class ReadsPairs(TermSettings):
    """Settings of a term that reads pairs, but no density."""

    reads = ("pairs",)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, settings, wanted", [
    ("pairs", None, '"pairs"'), ("velocity", None, '"pairs"'), ("resolved", None, '"resolved"'),
    ("density", ReadsPairs(), '"density"'), ("resolved", ReadsPairs(), '"resolved"')])
def test_what_a_term_does_not_declare_it_is_told_to(comm, name, settings, wanted):
    slab, particles = alone(*state()[:2])
    with pytest.raises(TermError, match=f"no term of this model reads {wanted}: add it to the `reads`"):
        dynamics_of(slab, of_terms(Asking(name, settings))).rates(particles)


@pytest.mark.mpi(1, 2)
def test_the_mean_over_all_particles_of_all_ranks_is_taken_off(comm):
    slab, particles = distributed(comm, *state(kind="void"))
    context = dynamics_of(slab, model()).context(particles)
    rows = particles.position * torch.tensor([1.0, 2.0, 3.0])
    everything = state(kind="void")[0] * torch.tensor([1.0, 2.0, 3.0])
    assert torch.allclose(context.without_mean(rows), rows - everything.mean(0), atol=1e-12)


@pytest.mark.mpi(1)
def test_moments_of_evenly_spread_neighbours_are_the_expected_ones(comm):
    """On a fine lattice: 8/315 n h^2 on the diagonal and 8/35 n, with a thousandth more."""
    side = 16
    axis = torch.arange(side, dtype=torch.float64) * (2 * torch.pi / side)
    position = torch.cartesian_prod(axis, axis, axis)
    slab, particles = alone(position, torch.zeros_like(position))
    around = dynamics_of(slab, model(pairs={}, eddy_viscosity={})).context(particles).moments
    found = (4 / 3 * torch.pi * CUTOFF**3) / (2 * torch.pi / side) ** 3  # neighbours that there are, not the NEIGHBORS
    weight = around.weight - 1e-3 * moments.expected_weight(NEIGHBORS)
    assert torch.allclose(weight, torch.tensor(found * 8 / 35 - 1).double(), rtol=2e-2)
    diagonal = torch.tensor([1.0, 0, 0, 1, 0, 1], dtype=torch.float64)[:, None]
    expected = moments.expected_moment(found, CUTOFF / SCALES.filter_width)
    small = 1e-3 * moments.expected_moment(NEIGHBORS, CUTOFF / SCALES.filter_width)
    assert torch.allclose(around.inverse * (expected + small), diagonal.expand_as(around.inverse), atol=2e-2)


@pytest.mark.mpi(1)
def test_pairs_are_taken_in_blocks_that_fit_the_cache(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    monkeypatch.setitem(context_module.PAIR_VALUES_TOGETHER, "cpu", 400)
    context = dynamics_of(slab, model(pairs={})).context(particles)
    sizes = [len(pairs.distance) for pairs in context.scaled_pairs(8)]
    assert len(sizes) > 10 and max(sizes) <= 400 / 8 + 60  # at least a particle's neighbours
    assert sum(sizes) == sum(len(pairs.distance) for pairs in context.scaled_pairs(1))


@dataclass(frozen=True, kw_only=True)
class GivesDensity(TermSettings):
    """Settings of a sum over pairs that gives a part of the density."""

    reads = ("pairs",)
    gives = ("density",)


class WeightedMean(PairTerm):
    """A density, of all particles, made with the moments of their neighbourhoods."""

    Settings = GivesDensity
    needs_moments = True

    def pair_values(self, pairs):
        return (pairs.weight * pairs.distance).unsqueeze(0)

    def rates_of(self, sums, context):
        return Rates(density=(sums / context.moments.weight)[0])


@pytest.mark.mpi(1, 2)
def test_a_density_is_summed_for_all_particles_whichever_are_asked_for(comm):
    """Also where it needs moments, and a pair sum for the few needs them too."""
    slab, particles = distributed(comm, *state())
    given = WeightedMean(GivesDensity(), of_terms().flow).double()
    lagrangian = of_terms(given, *model(pairs={}, eddy_viscosity={}).terms.values())
    rows = torch.arange(0, len(particles), 3)
    whole = dynamics_of(slab, lagrangian).rates(particles)
    some = dynamics_of(slab, lagrangian).rates(particles, rows)
    assert torch.allclose(some.density, whole.density, atol=1e-14)
    assert torch.allclose(some.acceleration, whole.acceleration[rows], rtol=1e-12, atol=1e-14)
