"""Recognising a simulation that has gone wrong, and saying where."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox


@dataclass(frozen=True)
class Limits:
    """Largest magnitudes a sound state can have: `speed`, and `density_deviation` from `density_mean` where particles
    have a density."""

    speed: float
    density_mean: float = 0.0
    density_deviation: float = math.inf


def find_fault(
    particles: ParticleSet, limits: Limits, box: PeriodicBox, step: int, rank: int
) -> str | None:
    """What is wrong with the first faulty particle of this rank, or None.

    Faulty are values that are not finite, and those beyond the limits. The description has the step, rank,
    particle id, position, velocity, density, and the nearest other particle of this rank.
    """
    # Comparisons with NaN are false, so what is asked is whether a particle is sound.
    sound = torch.linalg.vector_norm(particles.velocity, dim=1) <= limits.speed
    sound &= torch.isfinite(particles.position).all(1)
    if particles.density is not None:
        sound &= torch.isfinite(particles.density)
        sound &= (particles.density - limits.density_mean).abs() <= limits.density_deviation
    if bool(sound.all()):
        return None
    row = int(torch.nonzero(~sound)[0])
    return f"step {step}, rank {rank}, {_description(particles, box, row, _complaint(particles, limits, row))}"


def find_unplaced(particles: ParticleSet, outside: Tensor, box: PeriodicBox, rank: int) -> str | None:
    """The first particle of this rank that is farther outside its slab than the box is long, described as by
    `find_fault`; or None. `outside` (n,): how far each one is, infinite where its position is not finite."""
    unplaced = outside > box.length
    if not bool(unplaced.any()):
        return None
    row = int(torch.nonzero(unplaced)[0])
    finite = bool(torch.isfinite(outside[row]))
    complaint = "farther outside its slab than the box is long" if finite else "not finite"
    return f"rank {rank}, {_description(particles, box, row, complaint)}"


def _description(particles: ParticleSet, box: PeriodicBox, row: int, complaint: str) -> str:
    density = "" if particles.density is None else f"density {float(particles.density[row]):.6g}, "
    return (
        f"particle {int(particles.id[row])}: {complaint}; position {_numbers(particles.position[row])}, "
        f"velocity {_numbers(particles.velocity[row])}, {density}{_nearest(particles, box, row)}"
    )


def _complaint(particles: ParticleSet, limits: Limits, row: int) -> str:
    if not all(bool(torch.isfinite(column[row]).all()) for column in particles.columns().values()):
        return "not finite"
    if float(torch.linalg.vector_norm(particles.velocity[row])) > limits.speed:
        return f"faster than {limits.speed:.6g}"
    return f"density farther than {limits.density_deviation:.6g} from {limits.density_mean:.6g}"


def _nearest(particles: ParticleSet, box: PeriodicBox, row: int) -> str:
    difference = box.displacement(particles.position, particles.position[row])
    distance = torch.linalg.vector_norm(difference, dim=1)
    distance[row] = torch.inf
    distance = torch.where(torch.isnan(distance), torch.inf, distance)
    other = int(torch.argmin(distance))
    if not torch.isfinite(distance[other]):
        return "no other particle to measure a distance to"
    return f"nearest particle {int(particles.id[other])} at a distance of {float(distance[other]):.6g}"


def _numbers(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values.tolist()) + ")"
