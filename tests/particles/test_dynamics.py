from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from eddies.parallel.halo import HaloError, HaloExchange
from eddies.parallel.reduction import global_sum, sum_flat
from eddies.particles import context, neighborhood
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import CubicSpline
from eddies.particles.terms.term import PairTerm, Term
from eddies.scene.terms import TermSettings
from tests.particles.configurations import (
    CUTOFF, FLOW, LENGTH, MODELS, PAIR_MODELS, SCALES, alone, assert_close, by_id, by_torch, distributed, dynamics_of,
    given, model, of_terms, state, summed_density,
)

SKIN = 0.2
# Of each solve for the resolved velocity: on any number of ranks the same ones.
ITERATIONS = 8
every_model = pytest.mark.parametrize("terms", MODELS.values(), ids=MODELS)


def loss_of(slab, particles, force, total):
    """A loss over all particles, summed over ranks, and its gradients, summed over ranks."""
    dynamics = dynamics_of(slab, force, iterations=ITERATIONS)
    rates = dynamics.rates(dynamics.settle(particles)[0])
    share = sum((rate**2).sum() for rate in given(rates).values()) / total
    gradients = torch.autograd.grad(share, list(force.parameters()))
    sums = [np.array(share.item()), *(gradient.numpy().copy() for gradient in gradients)]
    sum_flat(slab.comm, sums)
    return sums


@pytest.mark.mpi(2, 3)
@every_model
def test_rates_loss_and_gradients_do_not_depend_on_the_ranks(comm, terms):
    for kind in ("even", "uneven", "void", "coincident"):
        columns = state(kind=kind)
        if kind == "void":
            columns[0][:, 2] *= 0.9  # all on the first of three ranks
        assert_same_on_all_ranks(comm, model(terms), columns)


def assert_same_on_all_ranks(comm, force, columns):
    (slab, particles), (whole, everything) = distributed(comm, *columns), alone(*columns)
    rates, expected = (given(dynamics_of(slabs, force, iterations=ITERATIONS).rates(which))
                       for slabs, which in ((slab, particles), (whole, everything)))
    assert rates.keys() == expected.keys()
    for name in expected:
        reference = expected[name][torch.argsort(everything.id)].detach()
        actual = by_id(comm, particles, rates[name], 200)
        # Of particles at one point nothing is resolved: what acts on it is round-off, as are its derivatives below.
        assert (actual - reference).abs().max() <= 1e-12 * max(float(reference.abs().max()), 0.1)
    if not list(force.parameters()):
        return
    sums, expected = loss_of(slab, particles, force, 200), loss_of(whole, everything, force, 200)
    for actual, reference in zip(sums, expected):
        assert np.abs(actual - reference).max() <= 1e-12 * max(np.abs(reference).max(), 1e-10)


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("integrator, name", [("verlet", "paper"), ("rk4", "corrected"), ("rk4", "antisymmetric"),
                                              ("verlet", "told densities"), ("rk3", "resolved + pairs")])
def test_gradients_through_several_steps_do_not_depend_on_the_ranks(comm, integrator, name):
    """Steps long enough for particles to leave their slabs and for lists to be built anew on the way."""
    columns = state(120)
    force = model(MODELS[name])

    def gradients(slab, particles):
        columns = {name: column.clone() for name, column in particles.columns().items()}
        inputs = [columns[name].requires_grad_() for name in ("position", "velocity", "density")]
        dynamics = dynamics_of(slab, force, SKIN / 2, ITERATIONS, drift=0.5)
        stepper, end = INTEGRATORS[integrator](dynamics), ParticleSet(**columns)
        for _ in range(3):
            end = stepper.step(end, 0.04)
        loss = sum((column**2).sum() for column in (end.position, end.velocity, end.density))
        found = torch.autograd.grad(loss, [*inputs, *force.parameters()], materialize_grads=True)
        assert dynamics.neighborhood.builds > 1
        return found

    slab, particles = distributed(comm, *columns)
    whole, everything = alone(*columns)
    found, expected = gradients(slab, particles), gradients(whole, everything)
    order = torch.argsort(everything.id)
    for actual, reference in zip(found[:3], expected[:3]):
        assert_close(by_id(comm, particles, actual, 120), reference[order], 1e-11)
    parameters = [gradient.numpy().copy() for gradient in found[3:]]
    if parameters:
        sum_flat(comm, parameters)
    for actual, reference in zip(parameters, expected[3:]):
        assert_close(torch.from_numpy(actual), reference, 1e-11)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("name, integrator, steps", [("pairs", "verlet", 25), ("told densities", "verlet", 25),
                                                     ("resolved + pairs", "rk3", 5), ("resolved", "rk3", 5)])
def test_particles_that_cross_slabs_go_on_as_on_one_rank(comm, name, integrator, steps):
    position, velocity, density = state(150)
    columns = position, velocity + torch.tensor([0.0, 0.0, 2.0]), density
    ends = []
    for slab, particles in (distributed(comm, *columns), alone(*columns)):
        dynamics, start = dynamics_of(slab, model(MODELS[name]), iterations=ITERATIONS), particles
        stepper = INTEGRATORS[integrator](dynamics)
        with torch.no_grad():
            for _ in range(steps):
                particles = stepper.step(particles, 0.2 / steps)
        assert dynamics.neighborhood is None if name == "resolved" else 2 < dynamics.neighborhood.builds < 20
        assert slab.size == 1 or set(start.id.tolist()) != set(particles.id.tolist())
        ends.append(by_id(slab.comm, particles, particles.velocity, 150))
    assert_close(*ends, 1e-10)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("symmetry, kept", [("antisymmetric", True), ("none", False)])
def test_opposite_forces_keep_the_total_momentum(comm, symmetry, kept):
    """To round-off over 40 steps, with pairs across the faces of slabs and particles that change rank."""
    position, velocity, density = state(150)
    slab, particles = distributed(comm, position, velocity + torch.tensor([0.0, 0.0, 2.0]), density)
    force = model({**MODELS["paper"], "pairs": dict(basis="paper", symmetry=symmetry),
                   "eddy-viscosity": dict(form="monaghan", basis="paper")})
    stepper = INTEGRATORS["verlet"](dynamics_of(slab, force))
    end = particles
    with torch.no_grad():
        for _ in range(40):
            end = stepper.step(end, 0.0125)
    change = global_sum(comm, (end.velocity.sum(0) - particles.velocity.sum(0)).numpy())
    speeds = float(global_sum(comm, float(particles.velocity.norm(dim=1).sum())))
    changed = float(global_sum(comm, float(end.velocity.square().sum() - particles.velocity.square().sum())))
    assert abs(changed) > 1
    assert np.abs(change).max() < 1e-13 * speeds if kept else np.abs(change).max() > 1e-6 * speeds


@pytest.mark.mpi(1)
def test_each_pair_is_evaluated_once(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    by_torch(monkeypatch)
    evaluated = []

    def noting(network, features):
        evaluated.append(features.shape[1])
        return plain(network, features)

    plain = DenseNetwork.forward
    monkeypatch.setattr(DenseNetwork, "forward", noting)
    monkeypatch.setitem(context.PAIR_VALUES_TOGETHER, "cpu", 300)
    counts = {}
    for symmetry in ("none", "antisymmetric"):
        evaluated.clear()
        with torch.no_grad():
            dynamics_of(slab, model(pairs=dict(basis="paper", symmetry=symmetry))).rates(particles)
        assert len(evaluated) > 3
        counts[symmetry] = sum(evaluated)
    assert counts["none"] == 2 * counts["antisymmetric"] > 0


@pytest.mark.mpi(1, 2)
def test_particles_outside_their_slab_see_all_their_neighbours(comm):
    """As where a gradient is recorded, and nothing changes rank."""
    position, velocity, density = state(400)
    slab, particles = distributed(comm, position, velocity, density)
    moved = position + 0.6 * torch.sin(7 * position)
    strayed = replace(particles, position=moved[particles.id])
    whole, everything = alone(moved, velocity, density)
    rates, expected = (dynamics_of(slabs, model(pairs={})).rates(which).acceleration.detach()
                       for slabs, which in ((slab, strayed), (whole, everything)))
    assert comm.size == 1 or bool(((strayed.position[:, 2] < slab.lower) | (strayed.position[:, 2] > slab.upper)).any())
    assert_close(by_id(comm, strayed, rates, 400), expected[torch.argsort(everything.id)])


class Recorder:
    """Notes what a halo sends."""

    def __init__(self, monkeypatch):
        self.sent = []
        for name in ("forward", "forward_positions"):
            monkeypatch.setattr(HaloExchange, name, self.noting(name, getattr(HaloExchange, name)))

    def noting(self, name, method):
        def noted(halo, column):
            self.sent.append((name, column.shape[1:]))
            return method(halo, column)

        return noted


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name, shapes", [("without density", [(3,)]), ("pairs", [(), (3,)])])
def test_only_columns_that_are_read_travel(comm, monkeypatch, name, shapes):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(PAIR_MODELS[name]))
    dynamics.rates(particles)
    recorder = Recorder(monkeypatch)
    moved = replace(particles, position=particles.position.clone())
    dynamics.rates(moved)
    # The positions' exchange is made of one of rows.
    columns = [("forward", shape) for shape in shapes]
    assert sorted(recorder.sent) == sorted([("forward_positions", (3,)), ("forward", (3,)), *columns])
    # At the same places once more only the columns.
    recorder.sent.clear()
    dynamics.rates(replace(moved, velocity=2 * moved.velocity))
    assert sorted(recorder.sent) == sorted(columns)


@pytest.mark.mpi(1, 2)
@torch.no_grad()
def test_what_places_tell_is_told_anew_when_they_are_changed_or_listed_anew(comm):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(PAIR_MODELS["pairs"]))
    before = dynamics.rates(particles).acceleration
    particles.position[:, 0] *= 0.999
    expected = dynamics_of(slab, model(PAIR_MODELS["pairs"])).rates(particles).acceleration
    assert torch.allclose(dynamics.rates(particles).acceleration, expected, rtol=0, atol=1e-12)
    assert not torch.allclose(before, expected, rtol=0, atol=1e-6)
    surroundings = dynamics.context(particles).surroundings
    assert dynamics.context(replace(particles, velocity=-particles.velocity)).surroundings is surroundings
    assert dynamics.context(replace(particles, id=particles.id.clone())).surroundings is not surroundings


@pytest.mark.mpi(1, 2)
def test_without_terms_that_look_at_others_there_is_no_list_no_halo_and_no_migration(comm, monkeypatch):
    def forbidden(*arguments):
        raise AssertionError("nothing of this is needed")

    slab, particles = distributed(comm, *state())
    for name in ("HaloExchange", "NeighborList", "migrate", "any_rank", "global_max"):
        monkeypatch.setattr(neighborhood, name, forbidden)
    dynamics = dynamics_of(slab, model({}))
    moved = INTEGRATORS["verlet"](dynamics).step(particles, 0.5)
    assert torch.equal(moved.position, dynamics.box.wrap(particles.position + 0.5 * particles.velocity))
    assert dynamics.neighborhood is None and dynamics.resolution is None
    assert torch.all((moved.position >= 0) & (moved.position < LENGTH))


@pytest.mark.mpi(1, 2)
def test_a_force_of_zero_amplitude_changes_nothing(comm):
    slab, particles = distributed(comm, *state())
    plain = dynamics_of(slab, model(pairs={})).rates(particles).acceleration
    forced = dynamics_of(slab, model(pairs={}, injection=dict(injection_rate=0.0)))
    assert torch.equal(forced.rates(particles).acceleration, plain)


@pytest.mark.mpi(1, 2)
def test_terms_are_added(comm):
    slab, particles = distributed(comm, *state())
    terms = {**MODELS["pressure"], "injection": dict(injection_rate=0.4)}
    together = dynamics_of(slab, model(terms)).rates(particles)
    apart = [dynamics_of(slab, model({word: terms[word]})).rates(replace(particles, density=together.density))
             for word in terms]
    assert torch.allclose(together.acceleration, sum(rates.acceleration for rates in apart), atol=1e-12)


@pytest.mark.mpi(1, 2)
@every_model
def test_rates_of_some_rows_and_in_blocks_are_those_of_all(comm, monkeypatch, terms):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(terms))
    everything, rows = dynamics.rates(particles), torch.tensor([5, 2, 40])
    some = dynamics.rates(particles, rows)
    monkeypatch.setitem(context.PAIR_VALUES_TOGETHER, "cpu", 300)
    with torch.no_grad():
        blocks = given(dynamics.rates(particles))
    assert given(some).keys() == given(everything).keys() == blocks.keys()
    for name, whole in given(everything).items():
        # The density, where it is given, is that of all particles.
        assert torch.allclose(given(some)[name], whole if name == "density" else whole[rows], rtol=1e-12)
        assert torch.allclose(blocks[name], whole, rtol=1e-12)


@dataclass(frozen=True, kw_only=True)
class SineDensitySettings(TermSettings):
    """Settings of a density that depends on place."""

    gives = ("density",)


class SineDensity(Term):
    """A density that depends on place."""

    def forward(self, context):
        return Rates(density=SCALES.density * torch.sin(context.particles.position).sum(1))


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("stored", [True, False])
def test_terms_read_the_density_that_others_give(comm, stored):
    position, velocity, density = state()
    sine = 1 + SCALES.density * torch.sin(position).sum(1)
    slab, particles = distributed(comm, position, velocity, density if stored else None)
    whole, everything = alone(position, velocity, sine)
    force = model(pairs={})
    # Whatever the order of the terms.
    giving = of_terms(force.terms["pairs"], SineDensity(SineDensitySettings(), force.flow))
    rates = dynamics_of(slab, giving).rates(particles)
    expected = dynamics_of(whole, force).rates(everything).acceleration.detach()
    assert_close(by_id(comm, particles, rates.acceleration, 200), expected[torch.argsort(everything.id)])
    assert_close(by_id(comm, particles, rates.density, 200), sine)


@dataclass(frozen=True, kw_only=True)
class SummedDensitySettings(TermSettings):
    """Settings of a density that is a sum over neighbours."""

    reads = ("pairs",)
    gives = ("density",)


class SummedDensity(PairTerm):
    """sum_j m W, with the particle itself."""

    mutual = True

    def pair_values(self, pairs):
        return CubicSpline(CUTOFF).value(pairs.pairs.distance).unsqueeze(0)

    def rates_of(self, sums, context):
        itself = CubicSpline(CUTOFF).value(sums.new_zeros(()))
        return Rates(density=self.flow.particle_mass * (sums[0] + itself) - SCALES.density_mean)


@pytest.mark.mpi(1, 2)
def test_a_density_by_pairs_is_that_of_all_particles_whichever_are_asked_for(comm):
    """Others read it at their neighbours."""
    position, velocity, _ = state(120)
    slab, particles = distributed(comm, position, velocity)
    giving = of_terms(model(wcsph={}).terms["wcsph"], SummedDensity(SummedDensitySettings(), FLOW))
    whole = dynamics_of(slab, giving).rates(particles)
    assert_close(by_id(comm, particles, whole.density, 120), summed_density(position, CubicSpline(CUTOFF),
                                                                            FLOW.particle_mass))
    rows = torch.arange(1, len(particles), 3)
    some = dynamics_of(slab, giving).rates(particles, rows)
    assert_close(some.acceleration, whole.acceleration[rows], 1e-11)
    assert_close(some.density, whole.density)


@pytest.mark.mpi(1, 2)
def test_a_density_that_is_at_hand_stands_for_the_one_that_terms_would_give(comm):
    position, velocity, density = state()
    slab, particles = distributed(comm, position, velocity)
    dynamics = dynamics_of(slab, model(MODELS["pressure"]))
    own = dynamics.rates(particles)
    again = dynamics.rates(particles, density=own.density.detach())
    assert torch.equal(again.acceleration, own.acceleration) and torch.equal(again.density, own.density)
    other = density[particles.id]
    found = dynamics.rates(particles, density=other)
    force = dynamics_of(slab, model(pressure={})).rates(particles).acceleration
    expected = force + dynamics_of(slab, model(MODELS["pairs"])).rates(replace(particles, density=other)).acceleration
    assert torch.equal(found.density, other)
    assert_close(found.acceleration, expected)
    assert not torch.allclose(found.acceleration, own.acceleration)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", ["pairs", "corrected", "told densities", "resolved + pairs"])
def test_pairs_and_resolved_velocity_in_single_precision(comm, name):
    slab, particles = distributed(comm, *state())
    double = dynamics_of(slab, model(MODELS[name]), iterations=ITERATIONS).rates(particles)
    single = dynamics_of(slab, model(MODELS[name]).float(), iterations=ITERATIONS, dtype=torch.float32).rates(particles)
    assert given(single).keys() == given(double).keys()
    for found, expected in zip(given(single).values(), given(double).values()):
        assert found.dtype == torch.float64 and 0 < (found - expected).norm() < 1e-5 * expected.norm()


@pytest.mark.mpi(1, 2)
def test_settled_particles_stay_until_one_moves_too_far(comm):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(pairs={}))
    with torch.no_grad():
        settled, moved_along = dynamics.settle(particles, {"velocity": particles.velocity})
        assert torch.equal(moved_along["velocity"], settled.velocity)
        dynamics.rates(settled)
        near = replace(settled, position=settled.position + torch.tensor([0.0, 0.0, 0.24 * SKIN]))
        assert dynamics.settle(near)[0] is near
        far = replace(settled, position=settled.position + torch.tensor([0.0, 0.0, 0.51 * SKIN]))
        assert dynamics.settle(far)[0] is not far


@pytest.mark.mpi(1, 2)
def test_without_a_list_particles_come_home_as_soon_as_one_is_out_of_its_slab(comm):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS["resolved"]))
    with torch.no_grad():
        settled, _ = dynamics.settle(particles)
        assert torch.equal(settled.id, particles.id) and torch.equal(settled.position, particles.position)
        position = particles.position.clone()
        position[particles.id == 7, 2] = slab.upper
        moved, along = dynamics.settle(replace(particles, position=position), {"velocity": particles.velocity})
    assert torch.all((moved.position[:, 2] >= slab.lower) & (moved.position[:, 2] < slab.upper))
    assert torch.equal(along["velocity"], moved.velocity)
    before, after = set(particles.id.tolist()), set(moved.id.tolist())
    assert comm.allreduce(sorted(before - after)) == comm.allreduce(sorted(after - before)) == [7] * (comm.size > 1)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", ["resolved", "pairs"])
def test_a_position_that_is_not_a_number_is_told_by_all_ranks(comm, name):
    slab, particles = distributed(comm, *state())
    position = particles.position.clone()
    position[particles.id == 7, 1] = torch.nan
    dynamics = dynamics_of(slab, model(MODELS[name]))
    with torch.no_grad(), pytest.raises(HaloError, match="particle 7: .*not finite"):
        settled, _ = dynamics.settle(replace(particles, position=position))
        dynamics.rates(settled)


@pytest.mark.mpi(1, 2)
def test_evaluations_of_a_run_tell_later_ones_what_to_expect(comm):
    """From one to the next the solve needs less; a moment that stands alone does not know of them, nor a run begun
    anew; one that goes on from what is kept of the first does the very same."""
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS["resolved"]), tolerance=1e-3)

    def iterations(which, time=None):
        return which.context(particles, time=time).resolved.iterations

    with torch.no_grad():
        first = dynamics.rates_after(0.0, particles)
        assert iterations(dynamics) > 5 and iterations(dynamics, 0.0) <= 1
        alone = dynamics.rates(particles)
        assert torch.equal(alone.acceleration, first.acceleration)
        dynamics.time = 0.25
        dynamics.rates_after(0.01, particles)
        assert dynamics.evaluations == 2 and len(dynamics.resolution.solves) == 5
        again = dynamics_of(slab, dynamics.model, tolerance=1e-3)
        assert iterations(again, 0.3) == iterations(again)
        again.load_state_dict({name: column.clone() for name, column in dynamics.state_dict().items()})
        assert again.time == 0.25
        found, expected = (each.rates(particles, time=0.3).acceleration for each in (again, dynamics))
        assert torch.equal(found, expected) and not torch.equal(found, alone.acceleration)
        dynamics.begin()
        assert dynamics.time == dynamics.evaluations == 0 and iterations(dynamics, 0.3) == iterations(dynamics)
