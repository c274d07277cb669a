from dataclasses import replace

import numpy as np
import pytest
import torch
from clouds import LENGTH, by_id, distributed, model, state

from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS

every_integrator = pytest.mark.parametrize("name", INTEGRATORS)


class DragAndRotation:
    """A body force that depends on place and, strongly, on velocity."""

    cutoff, reads = 0.0, ("velocity",)

    def __call__(self, position, velocity):
        axis = velocity.new_tensor([[0.3, -1.0, 2.0]])
        turning = torch.linalg.cross(velocity, axis)
        drag = 0.4 * velocity * velocity.norm(dim=1, keepdim=True)
        return torch.sin(position).roll(1, dims=1) + turning - drag


@torch.no_grad()
def run(name, dynamics, particles, duration, steps):
    stepper = INTEGRATORS[name](dynamics)
    for _ in range(steps):
        particles = stepper.step(particles, duration / steps)
    return particles


def observed_order(name, term, slab, particles, total, duration, steps):
    """Order from halving the step, against a fine fourth-order run."""

    def end(name, steps):
        dynamics = ParticleDynamics(slab, LENGTH, [term], 0.3)
        final = run(name, dynamics, particles, duration, steps)
        return [by_id(slab.comm, final, column, total) for column in (final.velocity, final.density)]

    reference = end("rk4", 8 * steps)
    errors = []
    for factor in (1, 2):
        found = end(name, factor * steps)
        errors.append(max((a - b).norm().item() for a, b in zip(found, reference)))
    return np.log2(errors[0] / errors[1])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, order", [("verlet", 1.9), ("rk2", 1.9), ("rk4", 3.8)])
def test_order_with_a_force_that_depends_on_velocity(comm, name, order):
    slab, particles = distributed(comm, *state(20))
    assert observed_order(name, DragAndRotation(), slab, particles, total=20, duration=1.0, steps=20) > order


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, order", [("verlet", 1.9), ("rk2", 1.9), ("rk4", 2.8)])
def test_order_with_the_pair_model_and_its_density(comm, name, order):
    """The second derivative of a pair's weight jumps at the cutoff, which limits the order to three."""
    slab, particles = distributed(comm, *state(60))
    force = model(closure="learned-density")
    with torch.no_grad():
        force.density_factors[:] = torch.tensor([1.0, 0.4])  # the sound of the fluid
    assert observed_order(name, force, slab, particles, total=60, duration=0.1, steps=8) > order


@pytest.mark.mpi(1)
def test_verlet_evaluates_the_rates_once_a_step(comm):
    slab, particles = distributed(comm, *state(20))
    dynamics = ParticleDynamics(slab, LENGTH, [DragAndRotation()], 0.1)
    calls = []
    rates = dynamics.rates
    dynamics.rates = lambda particles: calls.append(1) or rates(particles)
    run("verlet", dynamics, particles, 1.0, 10)
    assert len(calls) == 11


@pytest.mark.mpi(1, 2)
def test_verlet_goes_on_bitwise_from_a_checkpoint(comm):
    slab, particles = distributed(comm, *state())

    def start():
        dynamics = ParticleDynamics(slab, LENGTH, [model(closure="paper-density")], 0.1)
        return dynamics, INTEGRATORS["verlet"](dynamics)

    with torch.no_grad():
        dynamics, stepper = start()
        for _ in range(4):
            particles = stepper.step(particles, 0.05)
        saved = replace(particles, **{name: column.clone() for name, column in vars(particles).items()})
        memory = {name: rate.clone() for name, rate in stepper.memory.items()}
        dynamics.forget()
        _, resumed = start()
        resumed.restore(saved, memory)
        for _ in range(4):
            particles, saved = stepper.step(particles, 0.05), resumed.step(saved, 0.05)
    assert all(torch.equal(getattr(particles, name), column) for name, column in vars(saved).items())


@pytest.mark.mpi(1)
def test_verlet_does_not_use_its_memory_for_other_particles(comm):
    slab, particles = distributed(comm, *state())
    stepper = INTEGRATORS["verlet"](ParticleDynamics(slab, LENGTH, [model()], 0.1))
    first = stepper.step(particles, 0.01)
    stepper.step(first, 0.01)
    again = stepper.step(particles, 0.01)
    assert torch.equal(torch.argsort(again.id), torch.argsort(first.id))
    assert torch.equal(again.velocity, first.velocity)


class SineClosure:
    cutoff, reads = 1.0, ()

    def fields(self, particles, local):
        return {"density": torch.sin(particles.position[:, 0])}


@pytest.mark.mpi(1, 2)
@every_integrator
def test_density_of_a_closure_is_that_last_evaluated(comm, name):
    slab, particles = distributed(comm, *state())
    end = run(name, ParticleDynamics(slab, LENGTH, [], 0.1, closure=SineClosure()), particles, 0.01, 5)
    assert torch.allclose(end.density, torch.sin(end.position[:, 0]), atol=0.01)
