"""Detection of particles in a faulty state, and a description of the first one."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox


@dataclass(frozen=True)
class Limits:
    """Largest allowed speed relative to the velocity `frame` (3,) and, for particles with a density, largest deviation
    of the density from `density_mean`."""

    speed: float
    frame: Tensor
    density_mean: float = 0.0
    density_deviation: float = math.inf


def find_fault(particles: ParticleSet, limits: Limits, box: PeriodicBox, step: int, rank: int) -> str | None:
    """Describe the first particle of this rank whose state is not finite or exceeds the limits; None if all are sound.

    The description contains step, rank, particle id, position, velocity, density and the nearest particle of the rank.
    """
    # Comparisons with NaN are false, so the test selects sound particles.
    speed = torch.linalg.vector_norm(particles.velocity - limits.frame.to(particles.velocity), dim=1)
    sound = speed <= limits.speed
    sound &= torch.isfinite(particles.position).all(1)
    if particles.density is not None:
        sound &= torch.isfinite(particles.density)
        sound &= (particles.density - limits.density_mean).abs() <= limits.density_deviation
    if bool(sound.all()):
        return None
    row = int(torch.nonzero(~sound)[0])
    if not all(bool(torch.isfinite(column[row]).all()) for column in particles.columns().values()):
        complaint = "not finite"
    elif float(speed[row]) > limits.speed:
        complaint = f"speed above the limit {limits.speed:.6g}"
    else:
        complaint = (f"density differs by more than {limits.density_deviation:.6g} from the mean "
                     f"{limits.density_mean:.6g}")
    return f"step {step}, rank {rank}, {_description(particles, box, row, complaint)}"


def find_unplaced(particles: ParticleSet, outside: Tensor, box: PeriodicBox, rank: int) -> str | None:
    """Describe the first particle of this rank that is farther outside its slab than the box is long, or return None.

    `outside` (n,) is the distance of each particle from the slab, infinite if its position is not finite."""
    unplaced = outside > box.length
    if not bool(unplaced.any()):
        return None
    row = int(torch.nonzero(unplaced)[0])
    finite = bool(torch.isfinite(outside[row]))
    complaint = "farther outside its slab than the box is long" if finite else "not finite"
    return f"rank {rank}, {_description(particles, box, row, complaint)}"


def _description(particles: ParticleSet, box: PeriodicBox, row: int, complaint: str) -> str:
    density = "" if particles.density is None else f"density {float(particles.density[row]):.6g}, "
    return (f"particle {int(particles.id[row])}: {complaint}; position {_numbers(particles.position[row])}, "
            f"velocity {_numbers(particles.velocity[row])}, {density}{_nearest(particles, box, row)}")


def _nearest(particles: ParticleSet, box: PeriodicBox, row: int) -> str:
    distance = torch.linalg.vector_norm(box.displacement(particles.position, particles.position[row]), dim=1)
    distance[row] = torch.inf
    distance = torch.where(torch.isnan(distance), torch.inf, distance)
    other = int(torch.argmin(distance))
    if not torch.isfinite(distance[other]):
        return "no other particle on this rank at a finite distance"
    return f"nearest particle {int(particles.id[other])} at a distance of {float(distance[other]):.6g}"


def _numbers(values: Tensor) -> str:
    return "(" + ", ".join(f"{value:.6g}" for value in values.tolist()) + ")"
