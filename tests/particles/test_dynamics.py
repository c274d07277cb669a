from dataclasses import replace

import numpy as np
import pytest
import torch
from clouds import CUTOFF, LENGTH, SCALES, by_id, distributed, model, state
from mpi4py import MPI

from eddies.parallel.halo import HaloExchange
from eddies.parallel.reduction import global_sum, sum_flat
from eddies.particles import dynamics as dynamics_module
from eddies.particles import surroundings
from eddies.particles.body_forces import LinearForcing
from eddies.particles.dense_network import DenseNetwork
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.particle_set import ParticleSet

SKIN = 0.2
MODELS = {
    "paper": dict(basis="paper", closure="paper-density", eddy_viscosity="two-sided"),
    "corrected": dict(basis="corrected", closure="learned-density", eddy_viscosity="monaghan"),
    "poisson": dict(),
    "antisymmetric": dict(basis="paper", closure="learned-density", symmetry="antisymmetric"),
}
every_model = pytest.mark.parametrize("choices", MODELS.values(), ids=list(MODELS))


def alone(position, velocity, density):
    """The same particles, all on one rank."""
    return distributed(MPI.COMM_SELF, position, velocity, density)


def assert_close(actual, expected, relative=1e-12):
    assert (actual - expected).abs().max() <= relative * expected.abs().max()


def loss_of(slab, particles, force, total):
    """A loss over all particles, summed over ranks, and its gradients, summed over ranks."""
    dynamics = ParticleDynamics(slab, LENGTH, [force], SKIN)
    rates = dynamics.rates(dynamics.settle(particles)[0])
    share = sum((rate**2).sum() for rate in rates.values()) / total
    gradients = torch.autograd.grad(share, list(force.parameters()))
    sums = [np.array(share.item()), *(gradient.numpy().copy() for gradient in gradients)]
    sum_flat(slab.comm, sums)
    return sums


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind", ["even", "uneven", "void", "coincident"])
@every_model
def test_rates_loss_and_gradients_do_not_depend_on_the_ranks(comm, choices, kind):
    columns = state(kind=kind)
    if kind == "void":
        columns[0][:, 2] *= 0.9  # all on the first of three ranks
    force = model(**choices)
    (slab, particles), (whole, everything) = distributed(comm, *columns), alone(*columns)
    rates = ParticleDynamics(slab, LENGTH, [force], SKIN).rates(particles)
    expected = ParticleDynamics(whole, LENGTH, [force], SKIN).rates(everything)
    for name in expected:
        reference = expected[name][torch.argsort(everything.id)].detach()
        assert_close(by_id(comm, particles, rates[name], 200), reference)
    sums, expected = loss_of(slab, particles, force, 200), loss_of(whole, everything, force, 200)
    for actual, reference in zip(sums, expected):
        assert np.abs(actual - reference).max() <= 1e-12 * np.abs(reference).max()


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("integrator", ["verlet", "rk4"])
@every_model
def test_gradients_through_several_steps_do_not_depend_on_the_ranks(comm, choices, integrator):
    """Steps long enough for particles to leave their slabs and for lists to be built anew on the way."""
    columns = state(120)
    force = model(**choices)

    def gradients(slab, particles):
        columns = {name: column.clone() for name, column in vars(particles).items()}
        inputs = [columns[name].requires_grad_() for name in ("position", "velocity", "density")]
        dynamics = ParticleDynamics(slab, LENGTH, [force], SKIN / 2)
        stepper, end = INTEGRATORS[integrator](dynamics), ParticleSet(**columns)
        for _ in range(3):
            end = stepper.step(end, 0.04)
        loss = sum((column**2).sum() for column in (end.position, end.velocity, end.density))
        found = torch.autograd.grad(loss, [*inputs, *force.parameters()])
        assert dynamics.surroundings.builds > 1
        return found

    slab, particles = distributed(comm, *columns)
    whole, everything = alone(*columns)
    found, expected = gradients(slab, particles), gradients(whole, everything)
    order = torch.argsort(everything.id)
    for actual, reference in zip(found[:3], expected[:3]):
        assert_close(by_id(comm, particles, actual, 120), reference[order], 1e-11)
    parameters = [gradient.numpy().copy() for gradient in found[3:]]
    sum_flat(comm, parameters)
    for actual, reference in zip(parameters, expected[3:]):
        assert_close(torch.from_numpy(actual), reference, 1e-11)


@pytest.mark.mpi(1, 2, 3)
def test_particles_that_cross_slabs_go_on_as_on_one_rank(comm):
    position, velocity, density = state(150)
    columns = position, velocity + torch.tensor([0.0, 0.0, 2.0]), density
    ends = []
    for slab, particles in (distributed(comm, *columns), alone(*columns)):
        dynamics, start = ParticleDynamics(slab, LENGTH, [model()], SKIN), particles
        stepper = INTEGRATORS["verlet"](dynamics)
        with torch.no_grad():
            for _ in range(50):
                particles = stepper.step(particles, 0.006)
        assert 3 < dynamics.surroundings.builds < 40
        assert slab.size == 1 or set(start.id.tolist()) != set(particles.id.tolist())
        ends.append(by_id(slab.comm, particles, particles.velocity, 150))
    assert_close(*ends, 1e-10)


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("symmetry, kept", [("antisymmetric", True), ("none", False)])
def test_opposite_forces_keep_the_total_momentum(comm, symmetry, kept):
    """To round-off over 100 steps, with pairs across the faces of slabs and particles that change rank."""
    position, velocity, density = state(150)
    slab, particles = distributed(comm, position, velocity + torch.tensor([0.0, 0.0, 2.0]), density)
    force = model(basis="paper", closure="paper-density", eddy_viscosity="monaghan", symmetry=symmetry)
    stepper = INTEGRATORS["verlet"](ParticleDynamics(slab, LENGTH, [force], SKIN))
    end = particles
    with torch.no_grad():
        for _ in range(100):
            end = stepper.step(end, 0.005)
    change = global_sum(comm, (end.velocity.sum(0) - particles.velocity.sum(0)).numpy())
    speeds = float(global_sum(comm, float(particles.velocity.norm(dim=1).sum())))
    changed = float(global_sum(comm, float(end.velocity.square().sum() - particles.velocity.square().sum())))
    assert abs(changed) > 1
    assert np.abs(change).max() < 1e-13 * speeds if kept else np.abs(change).max() > 1e-6 * speeds


@pytest.mark.mpi(1)
def test_each_pair_is_evaluated_once(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    evaluated = []

    def noting(network, features):
        evaluated.append(features.shape[1])
        return plain(network, features)

    plain = DenseNetwork.forward
    monkeypatch.setattr(DenseNetwork, "forward", noting)
    monkeypatch.setitem(dynamics_module.PAIR_VALUES_TOGETHER, "cpu", 300)
    counts = {}
    for symmetry in ("none", "antisymmetric"):
        evaluated.clear()
        with torch.no_grad():
            ParticleDynamics(slab, LENGTH, [model(basis="paper", symmetry=symmetry)], SKIN).rates(particles)
        assert len(evaluated) > 3
        counts[symmetry] = sum(evaluated)
    assert counts["none"] == 2 * counts["antisymmetric"] > 0


@pytest.mark.mpi(1, 2)
def test_particles_outside_their_slab_see_all_their_neighbours(comm):
    """As where a gradient is recorded, and nothing changes rank."""
    position, velocity, density = state(400)
    slab, particles = distributed(comm, position, velocity, density)
    moved = position + 0.8 * torch.sin(7 * position)
    strayed = replace(particles, position=moved[particles.id])
    whole, everything = alone(moved, velocity, density)
    rates, expected = (
        ParticleDynamics(slabs, LENGTH, [model()], SKIN).rates(which)["velocity"].detach()
        for slabs, which in ((slab, strayed), (whole, everything))
    )
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


class VelocityReader:
    """A pair term that reads no density."""

    cutoff, reads, width = CUTOFF, ("velocity",), 3

    def __call__(self, pairs, columns):
        assert set(columns) == {"velocity"}
        return {"velocity": pairs.sum(pairs.at_senders(columns["velocity"]) * 0.01)}


@pytest.mark.mpi(2)
def test_only_columns_that_are_read_travel(comm, monkeypatch):
    slab, particles = distributed(comm, *state())
    dynamics = ParticleDynamics(slab, LENGTH, [VelocityReader()], SKIN)
    dynamics.rates(particles)
    recorder = Recorder(monkeypatch)
    dynamics.rates(particles)
    # The positions' exchange is made of one of rows.
    assert recorder.sent == [("forward_positions", (3,)), ("forward", (3,)), ("forward", (3,))]


@pytest.mark.mpi(1, 2)
def test_without_pair_terms_there_is_no_list_no_halo_and_no_migration(comm, monkeypatch):
    def forbidden(*arguments):
        raise AssertionError("nothing of this is needed")

    slab, particles = distributed(comm, *state())
    for name in ("HaloExchange", "NeighborList", "migrate", "any_rank"):
        monkeypatch.setattr(surroundings, name, forbidden)
    dynamics = ParticleDynamics(slab, LENGTH, [], SKIN)
    moved = INTEGRATORS["verlet"](dynamics).step(particles, 0.5)
    assert torch.equal(moved.position, particles.position + 0.5 * particles.velocity)
    assert dynamics.surroundings is None
    settled, _ = dynamics.settle(moved)
    assert torch.all((settled.position >= 0) & (settled.position < LENGTH))


@pytest.mark.mpi(1, 2)
def test_a_force_of_zero_amplitude_changes_nothing(comm):
    slab, particles = distributed(comm, *state())
    force = model()
    plain = ParticleDynamics(slab, LENGTH, [force], SKIN).rates(particles)["velocity"].detach()
    forced = ParticleDynamics(slab, LENGTH, [force, LinearForcing(0.0, 2.0, comm)], SKIN)
    assert torch.equal(forced.rates(particles)["velocity"].detach(), plain)


@pytest.mark.mpi(1, 2)
def test_body_terms_are_added(comm):
    slab, particles = distributed(comm, *state())
    force, forcing = model(), LinearForcing(0.4, 2.0, comm)
    plain = ParticleDynamics(slab, LENGTH, [force], SKIN).rates(particles)["velocity"].detach()
    both = ParticleDynamics(slab, LENGTH, [force, forcing], SKIN).rates(particles)["velocity"].detach()
    assert torch.allclose(both - plain, forcing(particles.position, particles.velocity), atol=1e-12)


@pytest.mark.mpi(1, 2)
@every_model
def test_rates_of_some_rows_and_in_blocks_are_those_of_all(comm, monkeypatch, choices):
    slab, particles = distributed(comm, *state())
    dynamics = ParticleDynamics(slab, LENGTH, [model(**choices)], SKIN)
    everything, rows = dynamics.rates(particles), torch.tensor([5, 2, 40])
    some = dynamics.rates(particles, rows)
    monkeypatch.setitem(dynamics_module.PAIR_VALUES_TOGETHER, "cpu", 300)
    with torch.no_grad():
        blocks = dynamics.rates(particles)
    for name in everything:
        assert torch.allclose(some[name], everything[name][rows], rtol=1e-12)
        assert torch.allclose(blocks[name], everything[name], rtol=1e-12)


class Closure:
    """A density that depends on place, and looks at velocities farther away than the pairs."""

    cutoff, reads = 1.6, ("velocity",)

    def fields(self, particles, local):
        assert set(local.columns) == {"velocity"} and len(local.columns["velocity"]) == len(local.position)
        return {"density": 1 + SCALES.density * torch.sin(particles.position).sum(1)}


@pytest.mark.mpi(1, 2, 3)
def test_pair_terms_read_the_density_of_the_closure(comm):
    position, velocity, density = state()
    given = 1 + SCALES.density * torch.sin(position).sum(1)
    (slab, particles), (whole, everything) = distributed(comm, position, velocity, density), alone(
        position, velocity, given
    )
    force = model()
    rates = ParticleDynamics(slab, LENGTH, [force], SKIN, closure=Closure()).rates(particles)
    expected = ParticleDynamics(whole, LENGTH, [force], SKIN).rates(everything)["velocity"].detach()
    assert_close(by_id(comm, particles, rates["velocity"], 200), expected[torch.argsort(everything.id)])
    assert_close(by_id(comm, particles, rates["closure_density"], 200), given)


@pytest.mark.mpi(1, 2)
def test_pair_arithmetic_in_single_precision(comm):
    slab, particles = distributed(comm, *state())
    double = ParticleDynamics(slab, LENGTH, [model()], SKIN).rates(particles)["velocity"]
    single = ParticleDynamics(slab, LENGTH, [model().float()], SKIN, dtype=torch.float32)
    rates = single.rates(particles)["velocity"]
    assert rates.dtype == torch.float64
    assert 0 < (rates - double).norm() < 1e-5 * double.norm()


@pytest.mark.mpi(1, 2)
def test_settled_particles_stay_until_one_moves_too_far(comm):
    slab, particles = distributed(comm, *state())
    dynamics = ParticleDynamics(slab, LENGTH, [model()], SKIN)
    with torch.no_grad():
        settled, moved_along = dynamics.settle(particles, {"velocity": particles.velocity})
        assert torch.equal(moved_along["velocity"], settled.velocity)
        dynamics.rates(settled)
        near = replace(settled, position=settled.position + torch.tensor([0.0, 0.0, 0.24 * SKIN]))
        assert dynamics.settle(near)[0] is near
        far = replace(settled, position=settled.position + torch.tensor([0.0, 0.0, 0.51 * SKIN]))
        assert dynamics.settle(far)[0] is not far
