"""Particle clouds and models that the tests of this folder share."""

import math

import numpy as np
import torch

from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.reference_scales import ReferenceScales

LENGTH = 2 * math.pi
SCALES = ReferenceScales(
    length=1.2,
    spacing=0.6,
    velocity=0.9,
    density_mean=1.0,
    density=0.02,
    acceleration=1.7,
    density_rate=0.05,
    sound_speed=11.0,
    viscosity=0.01,
)
CUTOFF = 1.5
CLOUDS = {
    "even": lambda random, n: random.uniform(0, LENGTH, (n, 3)),
    "cluster across a corner": lambda random, n: random.normal(0, 0.4, (n, 3)) % LENGTH,
    "void": lambda random, n: random.uniform(0, LENGTH, (n, 3)) * [1, 1, 0.3],
    "uneven": lambda random, n: LENGTH * random.uniform(0, 1, (n, 3)) ** 4,
    "lattice": lambda random, n: np.argwhere(np.ones((8, 8, n // 64))) * (LENGTH / 8),
    "coincident": lambda random, n: np.full((n, 3), 6.28),
}


def cloud(kind="even", count=200, seed=3):
    """Positions (count, 3) as a tensor."""
    return torch.as_tensor(CLOUDS[kind](np.random.default_rng(seed), count) % LENGTH)


def state(count=200, seed=3, kind="even"):
    """Position, velocity and density of a cloud."""
    random = np.random.default_rng(seed + 1)
    velocity = torch.as_tensor(random.normal(0, SCALES.velocity, (count, 3)))
    density = torch.as_tensor(random.normal(1, SCALES.density, count))
    return cloud(kind, count, seed), velocity, density


def model(**choices):
    """A pair model with initial weights in double precision."""
    return PairModel(SCALES, CUTOFF, neighbors=12.0, **{"hidden": (6, 5), **choices})


def rates(model, position, velocity, density, cutoff=None, dtype=None):
    """The model's rates for all particles of a periodic box."""
    listed = NeighborList(PeriodicBox(LENGTH), cutoff or model.cutoff, 0.3)
    listed.build(position, position, exclude_self=True)
    return model(listed.pairs(position, position, dtype=dtype), {"velocity": velocity, "density": density})


def distributed(comm, position, velocity, density, planes=24):
    """The slabs, and the particles of this rank out of those of all."""
    slab = SlabDecomposition(comm, LENGTH, planes)
    own = np.arange(len(position)) % comm.size == comm.rank
    columns = {"id": np.arange(len(position)), "position": position.numpy(), "velocity": velocity.numpy()}
    columns["density"] = density.numpy()
    columns = {name: column[own] for name, column in columns.items()}
    return slab, ParticleSet.from_numpy(migrate(slab, columns))


def by_id(comm, particles, column, total):
    """A column of all particles, in order of id, on every rank."""
    whole = np.zeros((total, *column.shape[1:]))
    whole[particles.id.numpy()] = column.detach().numpy()
    return torch.from_numpy(global_sum(comm, whole))
