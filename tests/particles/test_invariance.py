"""The rates of the presets in other frames of reference, in other orientations and in other units of time."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.scene.terms import PRESETS
from tests.particles.configurations import (
    CUTOFF, LENGTH, NEIGHBORS, SCALES, by_id, distributed, dynamics_of, model, relative, state,
)

NAMES = "paper", "local", "resolved"
PLANES, COUNT = 14, 400
# Rows of the rotation matrices.
MIRROR, TURN = np.diag([-1.0, 1.0, 1.0]), np.roll(np.eye(3), 1, axis=0)


def acceleration(comm, name, *, rotation=None, shift=(0, 0, 0), wind=(0, 0, 0), time=1.0, precision=torch.float64):
    """The acceleration of random particles, (n, 3), turned back and in the first unit of time.

    The particles are turned by `rotation`, moved by `shift` cells of the grid, and get the velocity `wind`. `time` is
    the number of new units of time in an old one.
    """
    position, velocity, density = (column.numpy() for column in state(COUNT))
    rotation = np.eye(3) if rotation is None else rotation
    position = (position @ rotation.T + np.array(shift) * (LENGTH / PLANES)) % LENGTH
    velocity = (velocity @ rotation.T + wind) / time
    rates = dict(velocity=1, acceleration=2, density_rate=1, sound_speed=1, viscosity=1)
    scales = replace(SCALES, **{scale: getattr(SCALES, scale) / time**power for scale, power in rates.items()})
    lagrangian = model({word: dict(settings) for word, settings in PRESETS[name].items()},
                       FlowUnits(scales, CUTOFF, NEIGHBORS)).to(precision)
    columns = map(torch.from_numpy, (position, velocity, density))
    slab, particles = distributed(comm, *columns, planes=PLANES)
    if not lagrangian.integrates_density:
        particles = replace(particles, density=None)
    dynamics = dynamics_of(slab, lagrangian, iterations=8, dtype=precision)
    with torch.no_grad():
        found = by_id(comm, particles, dynamics.rates(particles).acceleration, COUNT).numpy()
    return found @ rotation * time**2


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", NAMES)
def test_a_boost_a_mirror_a_turn_and_a_shift_change_nothing(comm, name):
    """Rounding is multiplied by the condition of a neighbourhood in kriging, 1e5, and by forty times the velocity in
    the boost; so 1e-9 is rounding."""
    still = acceleration(comm, name)
    for changed in (dict(wind=(30.0, -20.0, 10.0)), dict(rotation=MIRROR), dict(rotation=TURN), dict(shift=(3, 1, 2)),
                    dict(rotation=TURN @ MIRROR, shift=(0, 5, 1), wind=(1.0, 2.0, 3.0))):
        assert relative(acceleration(comm, name, **changed), still) < 1e-9, changed


@pytest.mark.mpi(1)
@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("time", [1e-6, 1e6])
def test_the_unit_of_time_changes_nothing(comm, name, time):
    """In double precision nothing but rounding; in single precision squares of accelerations reach 1e25."""
    still = acceleration(comm, name)
    assert relative(acceleration(comm, name, time=time), still) < 1e-9
    single = relative(acceleration(comm, name, precision=torch.float32), still)
    # Rounding has the same size in each unit, but another value.
    assert relative(acceleration(comm, name, time=time, precision=torch.float32), still) < max(3 * single, 1e-4)


@pytest.mark.mpi(1)
def test_unevenly_seeded_particles_resolve_a_flow_that_moves(comm):
    """4096 particles in an ABC flow plus a wind, most of them where cos x is 1. The mean over the particles is off by
    0.4 rms velocities, which gives an error of 0.47."""
    random, wind = np.random.default_rng(1), np.array([40.0, -20.0, 30.0])
    position = random.uniform(0, LENGTH, (20000, 3))
    position = position[random.random(20000) < (1 + 0.9 * np.cos(position[:, 0])) / 1.9][:4096]

    def velocity(at):
        x, y, z = at.T
        return np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)], 1)

    scales = ReferenceScales(filter_width=1e-3, spacing=LENGTH / 16, velocity=1.0, acceleration=1.0, density_mean=1.0,
                             viscosity=0.0)
    solver = ResolvedVelocity.on_slabs(SlabDecomposition(comm, LENGTH, 28), scales, weight=1.0)
    _, particles = distributed(comm, *map(torch.from_numpy, (position, velocity(position) + wind)), planes=28)
    flow = solver.of(ParticleSet(particles.id, particles.position, particles.velocity))
    points = random.uniform(0, LENGTH, (500, 3)) * [1, 1, 1 / comm.size] + [0, 0, LENGTH * comm.rank / comm.size]
    found = flow.grid.at(flow.modes, flow.grid.points(torch.from_numpy(points))).numpy()
    assert relative(found - wind, velocity(points)) < 0.005
    assert np.abs(flow.mean.numpy() - wind).max() < 0.002
