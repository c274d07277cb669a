"""Particles that move with a transport velocity, and what integrators make of a shift."""

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Term
from eddies.scene.terms import PRESETS, TermSettings
from tests.particles.configurations import (
    LENGTH, SCALES, alone, by_id, distributed, dynamics_of, given, model, of_terms, rates, state,
)

SIDE = 10
SPACING = LENGTH / SIDE
FLOW = FlowUnits(replace(SCALES, spacing=SPACING), SPACING * (60 / (4 / 3 * math.pi)) ** (1 / 3), 60.0)
ONES = torch.ones(SIDE**3, dtype=torch.float64)


def lattice(disorder):
    """Positions (n, 3), each moved by up to `disorder` spacings to either side along the axes."""
    moved = np.random.default_rng(4).uniform(-disorder, disorder, (SIDE**3, 3))
    return torch.as_tensor((np.argwhere(np.ones((SIDE,) * 3)) + 0.5 + moved) * SPACING)


def nearest(position):
    """Distance of each particle to the next one."""
    apart = position[:, None] - position
    square = (apart - LENGTH * torch.round(apart / LENGTH)).square().sum(-1)
    return square.fill_diagonal_(torch.inf).min(1).values.sqrt()


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("integrator", ["verlet", "rk3"])
def test_disordered_particles_spread_out_where_the_fluid_rests(comm, integrator):
    """The closest of them part, and cells of two spacings hold more nearly the same number; velocity and density of the
    fluid stay as they are. The centre of mass does too: pairs push each other."""
    start = lattice(0.9)
    slab, particles = distributed(comm, start, torch.zeros_like(start), ONES)
    lagrangian = model(PRESETS["transport-velocity"], FLOW)
    stepper = INTEGRATORS[integrator](dynamics_of(slab, lagrangian, 0.3))
    moved = torch.zeros_like(start)
    with torch.no_grad():
        for _ in range(15):
            particles, shift = stepper.rates(particles)
            moved += 0.01 * by_id(comm, particles, shift.shift_velocity, SIDE**3)
            particles = stepper.step(particles, 0.01)
    end = by_id(comm, particles, particles.position, SIDE**3) % LENGTH
    spread = [np.histogramdd(position.numpy(), bins=[np.linspace(0, LENGTH, SIDE // 2 + 1)] * 3)[0].var()
              for position in (start % LENGTH, end)]
    assert spread[1] < 0.5 * spread[0]
    assert nearest(end).min() > 2 * nearest(start).min()
    assert moved.square().mean().sqrt() > 0.1 * SPACING
    assert moved.mean(0).abs().max() < 1e-12
    assert not particles.velocity.any() and torch.equal(particles.density, ONES[: len(particles)])


@pytest.mark.mpi(1)
def test_a_lattice_is_not_shifted(comm):
    found = rates(model({"transport-velocity": {}}, FLOW), lattice(0.0), torch.zeros(SIDE**3, 3, dtype=torch.float64),
                  ONES)
    assert found.shift_velocity.abs().max() < 1e-12 * SCALES.sound_speed


@pytest.mark.mpi(1)
def test_two_particles_push_each_other_by_the_background_pressure(comm):
    """w = p_b delta_t/m 2 V^2 dW/dr with p_b delta_t = rho_0 c h/4, away from each other."""
    r, h = 0.7, FLOW.cutoff / 2
    position = torch.tensor([[1.0, 1, 1], [1.0 + r, 1, 1]], dtype=torch.float64)
    force = model({"transport-velocity": {}}, FLOW)
    for sign in (1, -1):
        with torch.no_grad():
            force.terms["transport-velocity"].background.mul_(sign)  # its first value is 1/4
        shift = rates(force, position, torch.zeros_like(position), ONES[:2]).shift_velocity
        slope = float(force.terms["transport-velocity"].kernel.derivative(torch.tensor(r, dtype=torch.float64)))
        away = SCALES.sound_speed * h / 4 * 2 * SPACING**3 * -slope
        assert shift.tolist() == [pytest.approx([-away, 0, 0]), pytest.approx([away, 0, 0])]


@pytest.mark.mpi(1)
def test_the_velocity_follows_the_field_that_particles_are_shifted_through(comm):
    """(w.grad) v of a shear wave (sin z, 0, 0), but for what the sums miss among particles that are a little out of
    place: a sixth. A uniform velocity beside it changes nothing."""
    position = lattice(0.1)
    wave = torch.zeros_like(position)
    wave[:, 0] = torch.sin(position[:, 2])
    force = model({"transport-velocity": {}}, FLOW)
    found = rates(force, position, wave, ONES)
    expected = found.shift_velocity[:, 2] * torch.cos(position[:, 2])
    assert (found.shift_acceleration[:, 0] - expected).norm() < expected.norm() / 6
    assert not found.shift_acceleration[:, 1:].any() and found.acceleration.abs().max() == 0
    carried = rates(force, position, wave + torch.tensor([3.0, -7, 2]), ONES)
    assert torch.allclose(carried.shift_acceleration, found.shift_acceleration, rtol=0, atol=1e-12)


@pytest.mark.mpi(1, 2)
def test_rates_do_not_depend_on_ranks(comm):
    position, velocity, density = state(120)
    lagrangian = model(PRESETS["transport-velocity"])
    slab, particles = distributed(comm, position, velocity, density)
    found = dynamics_of(slab, lagrangian).rates(particles)
    expected = rates(lagrangian, position, velocity, density)
    for name, column in given(expected).items():
        whole = by_id(comm, particles, getattr(found, name), 120)
        assert torch.allclose(whole, column.detach(), rtol=0, atol=1e-12 * float(column.detach().abs().max())), name


@dataclass(frozen=True, kw_only=True)
class Shifting(TermSettings):
    """Settings of a shift that looks at each particle alone."""

    gives = ("shift_velocity",)


class Wind(Term):
    """A term of a user's: particles are carried beside the fluid, whose velocity changes along their way."""

    Settings = Shifting

    def __init__(self):
        super().__init__(Shifting(), FLOW)

    def forward(self, context):
        shift = torch.sin(context.particles.position).roll(1, dims=1)
        return Rates(shift_velocity=shift, shift_acceleration=-context.particles.velocity * shift)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name, order", [("verlet", 0.9), ("corrected-verlet", 0.9), ("rk2", 1.9), ("rk3", 2.9),
                                         ("rk4", 3.8)])
def test_order_with_a_shift(comm, name, order):
    """Verlet takes the shift of the step's start."""
    slab, start = alone(*state(20)[:2])

    def end(name, steps):
        stepper, particles = INTEGRATORS[name](dynamics_of(slab, of_terms(Wind()), 0.1)), start
        for _ in range(steps):
            particles = stepper.step(particles, 1 / steps)
        turns = particles.position / LENGTH
        return torch.cat([LENGTH * (turns - torch.round(turns - reference[:, :3] / LENGTH)) if len(reference)
                          else particles.position, particles.velocity], 1)[torch.argsort(particles.id)]

    reference = []
    reference = end("rk4", 160)
    first, second = ((end(name, steps) - reference).norm() for steps in (20, 40))
    assert math.log2(first / second) > order


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", INTEGRATORS)
def test_a_run_with_a_shift_goes_on_bitwise(comm, name):
    """What an integrator remembers holds the shift, and nothing of the kind where no term gives one."""
    slab, particles = distributed(comm, *state(100))

    def start(preset):
        return INTEGRATORS[name](dynamics_of(slab, model(PRESETS[preset]), 0.1))

    with torch.no_grad():
        stepper, other = start("transport-velocity"), start("wcsph")
        for each in (stepper, other):
            each.rates(each.step(particles, 0.002))
        assert not any("shift" in part for part in other.memory)
        particles = stepper.step(particles, 0.002)
        particles, _ = stepper.rates(particles)
        assert {"shift_velocity", "shift_acceleration"} <= set(stepper.memory)
        stepper.dynamics.forget()
        resumed = start("transport-velocity")
        resumed.restore(particles, stepper.memory)
        ends = [each.step(particles, 0.002) for each in (stepper, resumed)]
    assert all(torch.equal(getattr(ends[0], column), value) for column, value in ends[1].columns().items())
