from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles.integrators import INTEGRATORS
from eddies.particles.surroundings import Surroundings
from tests.particles.configurations import (
    MODELS, OWN_DENSITY, Field, by_id, distributed, dynamics_of, model, of_terms, state,
)

SKIN = 0.1
every_integrator = pytest.mark.parametrize("name", INTEGRATORS)


def drag_and_rotation(position, velocity):
    """An acceleration that depends on place and, strongly, on velocity."""
    axis = velocity.new_tensor([[0.3, -1.0, 2.0]])
    turning = torch.linalg.cross(velocity, axis)
    drag = 0.4 * velocity * velocity.norm(dim=1, keepdim=True)
    return torch.sin(position).roll(1, dims=1) + turning - drag


DRAG = of_terms(Field(drag_and_rotation))


@torch.no_grad()
def run(name, dynamics, particles, duration, steps, asking=None):
    """The particles after a time; with a number `asking`, the rates are asked for at every so many steps."""
    stepper = INTEGRATORS[name](dynamics)
    for step in range(1, steps + 1):
        particles = stepper.step(particles, duration / steps)
        if asking and step % asking == 0:
            particles, _ = stepper.rates(particles)
    return particles


def observed_order(name, force, slab, particles, total, duration, steps):
    """Order from halving the step, against a fine fourth-order run."""

    def end(name, steps):
        dynamics = dynamics_of(slab, force, 0.3)
        final = run(name, dynamics, particles, duration, steps)
        return [by_id(slab.comm, final, column, total) for name, column in final.columns().items()
                if name in ("velocity", "density")]

    reference = end("rk4", 8 * steps)
    errors = []
    for factor in (1, 2):
        found = end(name, factor * steps)
        errors.append(max((a - b).norm().item() for a, b in zip(found, reference)))
    return np.log2(errors[0] / errors[1])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, order", [("verlet", 1.9), ("corrected-verlet", 1.9), ("rk2", 1.9), ("rk3", 2.9),
                                         ("rk4", 3.8)])
def test_order_with_a_force_that_depends_on_velocity(comm, name, order):
    slab, particles = distributed(comm, *state(20))
    assert observed_order(name, DRAG, slab, particles, total=20, duration=1.0, steps=20) > order


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, order", [("verlet", 1.9), ("corrected-verlet", 1.9), ("rk2", 1.9), ("rk3", 2.8),
                                         ("rk4", 2.8)])
def test_order_with_the_pair_model_and_its_density(comm, name, order):
    """The second derivative of a pair's weight jumps at the cutoff, which limits the order to three; where particles
    have hardly a neighbour each one that enters shows, and the order is not seen at steps like these."""
    slab, particles = distributed(comm, *state(250))
    force = model(OWN_DENSITY)
    assert observed_order(name, force, slab, particles, total=250, duration=0.1, steps=8) > order


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, evaluations, more", [("verlet", 11, 2), ("corrected-verlet", 21, 0), ("rk2", 20, 1),
                                                     ("rk3", 30, 1), ("rk4", 40, 1)])
def test_how_often_the_rates_are_evaluated(comm, name, evaluations, more):
    """In ten steps, and where the rates are asked for after five and ten of them: the next step does not evaluate those
    of a Runge-Kutta scheme again, and a corrected Verlet step knows them. What the plain one keeps belongs to another
    velocity, and still serves the next step."""
    slab, particles = distributed(comm, *state(20))
    calls = []

    def counted(position, velocity):
        calls.append(1)
        return drag_and_rotation(position, velocity)

    dynamics = dynamics_of(slab, of_terms(Field(counted)), 0.1)
    plain = run(name, dynamics, particles, 1.0, 10)
    assert len(calls) == dynamics.evaluations == evaluations and dynamics.time == pytest.approx(1.0)
    calls.clear()
    dynamics.begin()
    asked = run(name, dynamics, particles, 1.0, 10, asking=5)
    assert len(calls) == evaluations + more
    assert all(torch.equal(getattr(asked, column), value) for column, value in plain.columns().items())


@pytest.mark.mpi(1, 2)
@every_integrator
@pytest.mark.parametrize("terms", ["paper", "without density"])
def test_rates_between_steps_are_those_of_the_particles(comm, name, terms):
    assert_rates_between_steps(comm, name, terms, strayed=SKIN / 2)


@pytest.mark.mpi(1)
@every_integrator
def test_rates_between_steps_of_a_resolved_velocity(comm, name):
    assert_rates_between_steps(comm, name, "resolved", strayed=0.0)


def assert_rates_between_steps(comm, name, terms, strayed):
    """Of particles that are in their slabs, or have strayed less than would make the list old."""
    slab, particles = distributed(comm, *state()[: 2 if terms == "without density" else 3])
    stepper = INTEGRATORS[name](dynamics_of(slab, model(MODELS[terms]), SKIN, tolerance=1e-9))
    with torch.no_grad():
        for _ in range(2):
            particles = stepper.step(particles, 0.05)
        particles, rates = stepper.rates(particles)
        expected = dynamics_of(slab, model(MODELS[terms]), SKIN, tolerance=1e-9).rates(particles)
    z = particles.position[:, 2]
    # On one rank they may be any period away.
    assert comm.size == 1 or torch.all((z >= slab.lower - strayed) & (z <= slab.upper + strayed))
    assert torch.allclose(rates.acceleration, expected.acceleration, rtol=0, atol=1e-6)
    assert (rates.density_rate is None) == (terms != "paper")
    if terms == "paper":
        assert torch.allclose(rates.density_rate, expected.density_rate, rtol=0, atol=1e-12)
    assert stepper.scheme.dense == (name != "verlet")


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name", ["verlet", "corrected-verlet", "rk3"])
@pytest.mark.parametrize("terms", ["paper", "pressure", "resolved", "without density"])
def test_a_run_goes_on_bitwise_from_a_checkpoint(comm, name, terms):
    """Of particles, memory, and the state of the dynamics; also where terms give the density, and where there is
    none."""
    slab, particles = distributed(comm, *state()[: 2 if terms == "without density" else 3])

    def start():
        dynamics = dynamics_of(slab, model(MODELS[terms]), SKIN, iterations=3)
        return dynamics, INTEGRATORS[name](dynamics)

    with torch.no_grad():
        dynamics, stepper = start()
        for _ in range(3):
            particles = stepper.step(particles, 0.05)
        if name == "rk3":
            assert stepper.memory == {}
            particles, _ = stepper.rates(particles)
        saved = replace(particles, **{name: column.clone() for name, column in particles.columns().items()})
        memory, kept = ({name: column.clone() for name, column in columns.items()}
                        for columns in (stepper.memory, dynamics.state_dict()))
        dynamics.forget()
        again, resumed = start()
        again.load_state_dict(kept)
        resumed.restore(saved, memory)
        for _ in range(3):
            particles, saved = stepper.step(particles, 0.05), resumed.step(saved, 0.05)
        given = {"paper": ["density_rate"], "pressure": ["density"]}.get(terms, [])
        assert set(memory) == {"acceleration", *given} and again.time == dynamics.time
    assert all(torch.equal(getattr(particles, name), column) for name, column in saved.columns().items())


@pytest.mark.mpi(1)
def test_verlet_does_not_use_its_memory_for_other_particles(comm):
    slab, particles = distributed(comm, *state())
    stepper = INTEGRATORS["verlet"](dynamics_of(slab, model(pairs={}), 0.1))
    first = stepper.step(particles, 0.01)
    stepper.step(first, 0.01)
    again = stepper.step(particles, 0.01)
    assert torch.equal(torch.argsort(again.id), torch.argsort(first.id))
    assert torch.equal(again.velocity, first.velocity)


@pytest.mark.mpi(1, 2)
def test_weights_are_solved_for_once_where_particles_stay(comm, monkeypatch):
    """By a corrected Verlet step, which evaluates rates twice at its end, and anew after a checkpoint."""
    position = 2 * np.pi * np.random.default_rng(4).random((300, 3))
    columns = position, np.sin(position[:, [1, 2, 0]]), np.ones(300)
    slab, particles = distributed(comm, *map(torch.from_numpy, columns))
    dynamics = dynamics_of(slab, model({"filtered-equations": {}}), 0.0)
    solved, solve = [], Surroundings.solve_kriging
    monkeypatch.setattr(Surroundings, "solve_kriging", lambda around: solved.append(around.position) or solve(around))
    particles = run("corrected-verlet", dynamics, particles, 0.03, 3)
    assert dynamics.evaluations == 7 and len(solved) == 4  # the first at the start
    with torch.no_grad():
        again = dynamics.rates(particles).acceleration
        assert len(solved) == 4
        dynamics.forget()
        assert torch.equal(dynamics.rates(particles).acceleration, again) and len(solved) == 5


@pytest.mark.mpi(1, 2)
@every_integrator
def test_density_that_terms_give_is_that_last_evaluated(comm, name):
    slab, particles = distributed(comm, *state())
    dynamics = dynamics_of(slab, model(MODELS["pressure"]), 0.1)
    end = run(name, dynamics, particles, 0.01, 5)
    expected = dynamics.rates(end).density.detach()
    # The step before the last evaluation is as small as the change of the density by it.
    assert torch.allclose(end.density, expected, rtol=0, atol=0.1 * float((expected - 1).abs().max()))
    assert not torch.allclose(end.density, particles.density, atol=1e-3)


@pytest.mark.mpi(1, 2)
@every_integrator
@pytest.mark.parametrize("terms", ["without density", "resolved"])
def test_particles_without_a_density_are_stepped_as_those_with_one(comm, name, terms):
    position, velocity, density = state()
    ends = []
    for columns in ((position, velocity), (position, velocity, density)):
        slab, particles = distributed(comm, *columns)
        ends.append(run(name, dynamics_of(slab, model(MODELS[terms]), 0.1, iterations=3), particles, 0.1, 3))
    assert ends[0].density is None and torch.equal(ends[1].density, density[ends[1].id])
    assert torch.equal(ends[0].velocity, ends[1].velocity) and torch.equal(ends[0].position, ends[1].position)
    assert set(ends[0].columns()) == {"id", "position", "velocity"}


@pytest.mark.mpi(1, 2)
@every_integrator
def test_particles_get_the_density_that_terms_give(comm, name):
    """Also those that start without one."""
    slab, particles = distributed(comm, *state()[:2])
    end = run(name, dynamics_of(slab, model(MODELS["pressure"]), 0.1), particles, 0.05, 2)
    assert end.density.shape == (len(end),) and 0 < (end.density - 1).abs().max() < 0.1
