"""Models, particles and steps that the tests of extreme particles share."""

import math

import numpy as np
import pytest
import torch

from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.integrators import INTEGRATORS
from eddies.scene.terms import PRESETS
from tests.particles.configurations import LENGTH, OWN_DENSITY, by_id, distributed, dynamics_of
from tests.particles.configurations import model as model_of

TOTAL, PLANES, SKIN = 125, 9, 0.1  # 1.8 planes of the grid per particle and direction
# Of a solve: a fixed number, so that ranks and precisions agree; small, so that ill-posed arrangements do not amplify
# rounding.
ITERATIONS = 6
CLOSURES = {
    "pressure": {"pressure": {}, "pairs": {}},
    "resolved + pairs": PRESETS["resolved + pairs"],
    "own density": {**OWN_DENSITY, "eddy-viscosity": dict(form="monaghan")},
    "paper": {"pairs": dict(basis="paper", hidden=(8, 8)), "density-flux": dict(hidden=(8, 8)),
              "eddy-viscosity": dict(form="two-sided", basis="paper")},
    "wcsph": PRESETS["wcsph"],
    "local": PRESETS["local"],
}
every_closure = pytest.mark.parametrize("kind", ["resolved + pairs", "paper", "wcsph", "local"])


def units(total=TOTAL, neighbors=24.0, mach=0.1):
    """Units of turbulence with v_rms = 1 and the largest eddies of the box; density fluctuations scale with M_t^2."""
    spacing = LENGTH / round(total ** (1 / 3))
    scales = ReferenceScales(
        filter_width=2 * spacing, spacing=spacing, velocity=1.0, density_mean=1.0, density=0.3 * mach**2,
        acceleration=3.0, density_rate=0.5 * mach**2, sound_speed=math.sqrt(3) / mach,
        viscosity=0.02)
    return FlowUnits(scales, spacing * (neighbors * 3 / (4 * math.pi)) ** (1 / 3), neighbors)


def network_model(kind, mach=0.1):
    """A model with initial weights."""
    return model_of(CLOSURES[kind], units(mach=mach))


def has_grid(kind):
    """Whether the model has a force from its grid."""
    return "resolved" in network_model(kind).reads


def flow_velocity(position):
    """The ABC flow, v_rms = 1."""
    x, y, z = position.T
    return torch.stack([torch.sin(z) + torch.cos(y), torch.sin(x) + torch.cos(z), torch.sin(y) + torch.cos(x)], dim=1)


def random_points(total=TOTAL, seed=5):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, LENGTH, (total, 3)))


def set_up(comm, model, position, velocity=None, density=None, dtype=torch.float64):
    """Dynamics and this rank's particles; with the velocity of the flow and the mean density unless given."""
    velocity = flow_velocity(position) if velocity is None else velocity
    density = torch.ones(len(position), dtype=torch.float64) if density is None else density
    slab, particles = distributed(comm, position, velocity, density, planes=PLANES)
    return dynamics_of(slab, model.to(dtype), SKIN, ITERATIONS, dtype=dtype), particles


@torch.no_grad()
def acceleration(comm, model, position, **given):
    """Accelerations of all particles by id, on every rank."""
    dynamics, particles = set_up(comm, model, position, **given)
    [particles] = dynamics.settle(particles)
    return by_id(comm, particles, dynamics.rates(particles).acceleration, len(position))


@torch.no_grad()
def advance(dynamics, particles, integrator, step, count):
    stepper = INTEGRATORS[integrator](dynamics)
    for _ in range(count):
        particles = stepper.step(particles, step)
    return particles


ARRANGEMENTS = {
    "in 1 % of the box": random_points() * 0.01 ** (1 / 3),
    "in 1 % of the box, across a corner": (random_points() - math.pi) * 0.01 ** (1 / 3) % LENGTH,
    "empty octant": random_points(2 * TOTAL)[(random_points(2 * TOTAL) > math.pi).any(1)][:TOTAL],
    "in a plane": random_points() * torch.tensor([1.0, 1.0, 0.0]),
    "on a line": random_points() * torch.tensor([1.0, 0.0, 0.0]),
    "all at one point": torch.ones(TOTAL, 3, dtype=torch.float64),
}
