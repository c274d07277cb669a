from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.particles import neighborhood
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.rates import Rates
from eddies.scene.terms import PRESETS
from tests.particles.configurations import (
    LENGTH, MODELS, Field, Given, alone, by_id, distributed, dynamics_of, model, of_terms, state,
)

SKIN = 0.1
ORDERS = {"verlet": 2, "corrected-verlet": 2, "rk2": 2, "rk3": 3, "rk4": 4}


def drag_and_rotation(position, velocity):
    """An acceleration that depends on place and, strongly, on velocity."""
    turning = torch.linalg.cross(velocity, velocity.new_tensor([[0.3, -1.0, 2.0]]))
    drag = 0.4 * velocity * velocity.norm(dim=1, keepdim=True)
    return torch.sin(position).roll(1, dims=1) + turning - drag


DRAG = of_terms(Field(drag_and_rotation))


@torch.no_grad()
def run(name, dynamics, particles, duration, steps, rates_every=None):
    """The particles after a time; rates between steps are requested after every `rates_every` steps."""
    stepper = INTEGRATORS[name](dynamics)
    for step in range(1, steps + 1):
        particles = stepper.step(particles, duration / steps)
        if rates_every and step % rates_every == 0:
            particles, _ = stepper.rates(particles)
    return particles


def observed_order(name, force, particles, duration, steps, columns=("velocity", "density")):
    """Order of convergence from halving the step, against a fine fourth-order run."""
    slab, start = alone(*particles)

    def end(name, steps):
        final = run(name, dynamics_of(slab, force, 0.3), start, duration, steps)
        return [by_id(slab.comm, final, column, len(start)) for column_name, column in final.columns().items()
                if column_name in columns]

    def miss(one, other):
        apart = one - other
        return (apart - LENGTH * torch.round(apart / LENGTH)).norm().item()

    reference = end("rk4", 8 * steps)
    errors = [max(map(miss, end(name, factor * steps), reference)) for factor in (1, 2)]
    return np.log2(errors[0] / errors[1])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_order_with_a_force_that_depends_on_velocity(comm, name):
    assert observed_order(name, DRAG, state(20), duration=1.0, steps=20) > ORDERS[name] - 0.2


def wind(context):
    """A shift of the particles through a fluid whose velocity varies along it."""
    shift = torch.sin(context.particles.position).roll(1, dims=1)
    return Rates(shift_velocity=shift, shift_acceleration=-context.particles.velocity * shift)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, least", [("verlet", 0.9), ("corrected-verlet", 0.9), ("rk3", 2.8)])
def test_order_with_a_shift(comm, name, least):
    """Verlet uses the shift at the start of the step."""
    force = of_terms(Given(wind, gives=("shift_velocity",)))
    assert observed_order(name, force, state(20)[:2], 1.0, 20, ("position", "velocity")) > least


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, evaluations, more", [("verlet", 11, 2), ("corrected-verlet", 21, 0), ("rk3", 30, 1)])
def test_number_of_evaluations(comm, name, evaluations, more):
    """Ten steps, and ten with rates requested after five and ten of them. Only the last request of a Runge-Kutta scheme
    costs an evaluation, none of a corrected Verlet scheme, and each of a plain one. Results do not change."""
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
    interrupted = run(name, dynamics, particles, 1.0, 10, rates_every=5)
    assert len(calls) == evaluations + more
    assert all(torch.equal(getattr(interrupted, column), value) for column, value in plain.columns().items())


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", ["verlet", "corrected-verlet", "rk3"])
@pytest.mark.parametrize("terms", ["paper", "resolved"])
def test_rates_between_steps_are_those_of_the_particles(comm, name, terms):
    """Particles are in their slabs, or outside by less than makes the list outdated."""
    slab, particles = distributed(comm, *state())
    stepper = INTEGRATORS[name](dynamics_of(slab, model(MODELS[terms]), SKIN, tolerance=1e-9))
    with torch.no_grad():
        for _ in range(2):
            particles = stepper.step(particles, 0.05)
        particles, rates = stepper.rates(particles)
        expected = dynamics_of(slab, model(MODELS[terms]), SKIN, tolerance=1e-9).rates(particles)
    z, strayed = particles.position[:, 2], SKIN / 2 if terms == "paper" else 0.0
    assert comm.size == 1 or torch.all((z >= slab.lower - strayed) & (z <= slab.upper + strayed))
    assert torch.allclose(rates.acceleration, expected.acceleration, rtol=0, atol=1e-6)
    assert (rates.density_rate is None) == (terms != "paper")
    if terms == "paper":
        assert torch.allclose(rates.density_rate, expected.density_rate, rtol=0, atol=1e-12)
    assert stepper.scheme.dense == (name != "verlet")


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("name, terms, stored", [
    ("verlet", "paper", {"density_rate"}), ("corrected-verlet", "pressure", {"density"}),
    ("verlet", "without density", set()),
    ("rk3", "transport-velocity", {"density_rate", "shift_velocity", "shift_acceleration"})])
def test_a_run_continues_bitwise_from_a_checkpoint(comm, name, terms, stored):
    """A checkpoint has particles, memory and the state of the dynamics. Densities of each kind, and a shift."""
    slab, particles = distributed(comm, *state()[: 2 if terms == "without density" else 3])

    def start():
        dynamics = dynamics_of(slab, model({**MODELS, **PRESETS}[terms]), SKIN, iterations=3)
        return dynamics, INTEGRATORS[name](dynamics)

    with torch.no_grad():
        dynamics, stepper = start()
        for _ in range(3):
            particles = stepper.step(particles, 0.01)
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
            particles, saved = stepper.step(particles, 0.01), resumed.step(saved, 0.01)
    assert set(memory) == {"acceleration", *stored} and again.time == dynamics.time
    assert all(torch.equal(getattr(particles, name), column) for name, column in saved.columns().items())


@pytest.mark.mpi(2)
def test_kriging_weights_are_computed_once_for_the_same_positions(comm, monkeypatch):
    """A corrected Verlet step evaluates rates twice at its end; after a checkpoint weights are computed again."""
    position = 2 * np.pi * np.random.default_rng(4).random((300, 3))
    columns = position, np.sin(position[:, [1, 2, 0]]), np.ones(300)
    slab, particles = distributed(comm, *map(torch.from_numpy, columns))
    dynamics = dynamics_of(slab, model({"filtered-equations": {}}), 0.0)
    solved, kriging = [], neighborhood.Kriging
    monkeypatch.setattr(neighborhood, "Kriging", lambda *given: solved.append(1) or kriging(*given))
    particles = run("corrected-verlet", dynamics, particles, 0.03, 3)
    assert dynamics.evaluations == 7 and len(solved) == 4  # the first at the start
    with torch.no_grad():
        again = dynamics.rates(particles).acceleration
        assert len(solved) == 4
        dynamics.forget()
        assert torch.equal(dynamics.rates(particles).acceleration, again) and len(solved) == 5
        particles.position[:, 0] *= 0.999  # in place
        assert not torch.equal(dynamics.rates(particles).acceleration, again) and len(solved) == 6


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name, stored", [("verlet", True), ("corrected-verlet", False), ("rk3", False)])
def test_particles_have_the_density_that_terms_gave_last(comm, name, stored):
    slab, particles = distributed(comm, *state()[: 3 if stored else 2])
    dynamics = dynamics_of(slab, model(MODELS["pressure"]), 0.1)
    end = run(name, dynamics, particles, 0.01, 5)
    expected = dynamics.rates(end).density.detach()
    # The last evaluation is less than a step away.
    assert torch.allclose(end.density, expected, rtol=0, atol=0.1 * float((expected - 1).abs().max()))
    assert 0 < (end.density - 1).abs().max() < 0.1
