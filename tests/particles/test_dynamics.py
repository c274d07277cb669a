"""Rates of particles: equal on any number of ranks, with gradients, and with as little communication as possible."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import any_rank, sum_flat
from eddies.particles import context, neighborhood
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import Rates
from tests.particles.configurations import (
    LENGTH, MODELS, SCALES, Given, alone, assert_close, by_id, distributed, dynamics_of, given, model, of_terms, state,
)

SKIN = 0.2
# Iterations of each solve for the resolved velocity, equal on any number of ranks.
ITERATIONS = 8
# Every basis, symmetry and kind of density.
VARIOUS = ("published", "corrected", "antisymmetric", "sph", "pairs with density", "resolved")
various_models = pytest.mark.parametrize("name", VARIOUS)


def summed_over_ranks(comm, gradients):
    sums = [gradient.detach().numpy().copy() for gradient in gradients]
    if sums:
        sum_flat(comm, sums)
    return sums


@pytest.mark.mpi(2, 3)
@various_models
def test_rates_loss_and_gradients_do_not_depend_on_the_ranks(comm, name):
    """Particles may all be in one place or on the first of three ranks."""
    force = model(MODELS[name])
    for kind in ("uneven", "void", "coincident"):
        columns = state(kind=kind)
        if kind == "void":
            columns[0][:, 2] *= 0.9
        results = []
        for slab, particles in (distributed(comm, *columns), alone(*columns)):
            dynamics = dynamics_of(slab, force, iterations=ITERATIONS)
            rates = given(dynamics.rates(particles))
            parameters, loss = list(force.parameters()), sum((rate**2).sum() for rate in rates.values()) / 200
            gradients = torch.autograd.grad(loss, parameters) if parameters else []
            results.append(({name: by_id(slab.comm, particles, rate, 200) for name, rate in rates.items()},
                            summed_over_ranks(slab.comm, [loss, *gradients])))
        (rates, sums), (expected, expected_sums) = results
        assert rates.keys() == expected.keys()
        for name, reference in expected.items():
            # Coincident particles resolve nothing: forces and derivatives are rounding.
            assert (rates[name] - reference).abs().max() <= 1e-12 * max(float(reference.abs().max()), 0.1)
        for actual, reference in zip(sums, expected_sums):
            assert np.abs(actual - reference).max() <= 1e-12 * max(np.abs(reference).max(), 1e-2)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("integrator, name", [("rk4", "corrected"), ("verlet", "pairs with density")])
def test_gradients_through_several_steps_do_not_depend_on_the_ranks(comm, integrator, name):
    """Steps are long enough for particles to change rank and for lists to be rebuilt."""
    columns, force = state(120), model(MODELS[name])
    results = []
    for slab, particles in (distributed(comm, *columns), alone(*columns)):
        start = {name: column.clone() for name, column in particles.columns().items()}
        inputs = [start[name].requires_grad_() for name in ("position", "velocity", "density")]
        dynamics = dynamics_of(slab, force, SKIN / 2, ITERATIONS)
        stepper, end = INTEGRATORS[integrator](dynamics), ParticleSet(**start)
        for _ in range(3):
            end = stepper.step(end, 0.04)
        loss = sum((column**2).sum() for column in (torch.sin(end.position), end.velocity, end.density))
        gradients = torch.autograd.grad(loss, [*inputs, *force.parameters()], materialize_grads=True)
        assert dynamics.neighborhood.builds > 1
        assert slab.size == 1 or any_rank(slab.comm, set(end.id.tolist()) != set(particles.id.tolist()))
        results.append([by_id(slab.comm, particles, part, 120) for part in gradients[:3]]
                       + list(map(torch.from_numpy, summed_over_ranks(slab.comm, gradients[3:]))))
    for actual, reference in zip(*results):
        assert_close(actual, reference, 1e-11)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("name, integrator, steps", [("pairs", "verlet", 25), ("resolved", "rk3", 5)])
def test_particles_that_cross_slabs_move_as_on_one_rank(comm, name, integrator, steps):
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


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", [None, "resolved"])
@torch.no_grad()
def test_a_model_without_pairs_has_no_list_and_no_halo(comm, monkeypatch, name):
    slab, particles = distributed(comm, *state())
    forbidden = ["HaloExchange", "NeighborList"] + ([] if name else ["Migration", "any_rank", "global_max"])
    for each in forbidden:
        monkeypatch.setattr(neighborhood, each, lambda *given: pytest.fail("is not needed"))
    dynamics = dynamics_of(slab, model(MODELS.get(name)))
    moved = INTEGRATORS["verlet"](dynamics).step(particles, 0.5)
    assert dynamics.neighborhood is None and torch.all((moved.position >= 0) & (moved.position < LENGTH))
    if name is None:
        assert torch.equal(moved.position, dynamics.box.wrap(particles.position + 0.5 * particles.velocity))


@pytest.mark.mpi(2)
@various_models
def test_rates_of_some_rows_and_in_blocks_are_those_of_all(comm, monkeypatch, name):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS[name]))
    everything, rows = dynamics.rates(particles), torch.tensor([5, 2, 40])
    some = dynamics.rates(particles, rows)
    monkeypatch.setitem(context.PAIR_VALUES_TOGETHER, "cpu", 300)
    monkeypatch.setattr(context, "kernels_serve", lambda device: False)
    with torch.no_grad():
        blocks = given(dynamics.rates(particles))
    assert given(some).keys() == given(everything).keys() == blocks.keys()
    for rate, whole in given(everything).items():
        # A density that terms give is that of all particles.
        assert torch.allclose(given(some)[rate], whole if rate == "density" else whole[rows], rtol=1e-12)
        assert torch.allclose(blocks[rate], whole, rtol=1e-9, atol=1e-12)


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("stored", [True, False])
def test_terms_read_the_density_that_others_give(comm, stored):
    position, velocity, density = state()
    sine = 1 + SCALES.density * torch.sin(position).sum(1)
    slab, particles = distributed(comm, position, velocity, density if stored else None)
    whole, everything = alone(position, velocity, sine)
    force = model(pairs={})
    giving = Given(lambda context: Rates(density=SCALES.density * torch.sin(context.particles.position).sum(1)),
                   gives=("density",))
    rates = dynamics_of(slab, of_terms(force.terms["pairs"], giving)).rates(particles)  # in any order
    expected = dynamics_of(whole, force).rates(everything).acceleration.detach()
    assert_close(by_id(comm, particles, rates.acceleration, 200), expected[torch.argsort(everything.id)])
    assert_close(by_id(comm, particles, rates.density, 200), sine)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", ["corrected", "resolved"])
def test_computations_in_single_precision_differ_by_their_rounding(comm, name):
    """The parameters are the same."""
    (slab, particles), force = distributed(comm, *state()), model(MODELS[name]).float()
    single, double = (dynamics_of(slab, force, iterations=ITERATIONS, dtype=dtype).rates(particles).acceleration
                      for dtype in (torch.float32, torch.float64))
    assert single.dtype == torch.float64 and 0 < (single - double).norm() < 1e-5 * double.norm()


@pytest.mark.mpi(1, 2)
def test_settled_particles_stay_until_one_moves_too_far(comm):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(pairs={}))
    with torch.no_grad():
        settled, other = dynamics.settle(particles, particles)
        assert torch.equal(other.velocity, settled.velocity) and other.id is settled.id
        dynamics.rates(settled)
        near, far = (replace(settled, position=settled.position + torch.tensor([0.0, 0.0, way * SKIN]))
                     for way in (0.49, 0.51))
        assert dynamics.settle(near)[0] is near and dynamics.settle(far)[0] is not far


@pytest.mark.mpi(1, 2)
def test_without_a_list_particles_change_rank_as_soon_as_one_leaves_its_slab(comm):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS["resolved"]))
    with torch.no_grad():
        [settled] = dynamics.settle(particles)
        assert torch.equal(settled.id, particles.id) and torch.equal(settled.position, particles.position)
        position = particles.position.clone()
        position[particles.id == 7, 2] = slab.upper
        moved, before = dynamics.settle(replace(particles, position=position), particles)
    assert torch.all((moved.position[:, 2] >= slab.lower) & (moved.position[:, 2] < slab.upper))
    assert torch.equal(before.velocity, moved.velocity)
    left, came = (sorted(set(one.id.tolist()) - set(other.id.tolist()))
                  for one, other in ((particles, moved), (moved, particles)))
    assert comm.allreduce(left) == comm.allreduce(came) == [7] * (comm.size > 1)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", ["resolved", "pairs"])
def test_all_ranks_name_a_position_that_is_not_a_number(comm, name):
    slab, particles = distributed(comm, *state())
    particles.position[particles.id == 7, 1] = torch.nan
    dynamics = dynamics_of(slab, model(MODELS[name]))
    with torch.no_grad(), pytest.raises(HaloError, match="particle 7: .*not finite"):
        dynamics.rates(dynamics.settle(particles)[0])
