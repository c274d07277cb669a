"""All particles at a moment in the order of their ids, and interpolation between two moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from eddies.parallel.communicator import Comm
from eddies.parallel.migration import IdOrder
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates


@dataclass(frozen=True)
class Moment:
    """This rank's block of the particles at a moment.

    A block holds particles with consecutive ids, in order of id. They may lie in any slab.

    Parameters
    ----------
    time : time of the moment.
    first : first id of the block.
    position, velocity, acceleration : (n, 3); acceleration is the rate of change of the velocity.
    density, density_rate : (n,); None if the particles have no density.
    shift : (n, 3), velocity of the particles relative to the fluid; None if they move with the fluid.
    """

    time: float
    first: int
    position: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    density: np.ndarray | None = None
    density_rate: np.ndarray | None = None
    shift: np.ndarray | None = None

    @classmethod
    def of(cls, comm: Comm, total: int, time: float, particles: ParticleSet, rates: Rates) -> Moment:
        """Make a moment from the particles of each rank; `total` is their number over all ranks. Collective."""
        order = IdOrder(comm, as_numpy(particles.id), total)
        columns = {"position": particles.position, "velocity": particles.velocity, "acceleration": rates.velocity_rate,
                   "density": particles.density, "density_rate": rates.density_rate, "shift": rates.shift_velocity}
        if particles.density is not None and rates.density_rate is None:
            columns["density_rate"] = torch.zeros_like(particles.density)
        return cls(time, order.start, **{name: order.apply(as_numpy(column)) for name, column in columns.items()
                                         if column is not None})


def between(before: Moment, after: Moment, time: float, box: PeriodicBox) -> ParticleSet:
    """Interpolate the particles of this rank's block to `time`, which lies between two moments.

    Each position follows a Hermite polynomial of fifth degree, which matches position, velocity and acceleration at
    both moments. Its error is of sixth order in the interval. Velocities and densities follow polynomials of third
    degree, which match values and rates of change. Their errors are of fourth order.
    """
    step = after.time - before.time
    theta = (time - before.time) / step
    first, last, pull, last_pull = before.velocity, after.velocity, before.acceleration, after.acceleration
    if before.shift is not None:  # the shift's rate of change is unknown; the mean rate replaces it
        first, last, turning = first + before.shift, last + after.shift, (after.shift - before.shift) / step
        pull, last_pull = pull + turning, last_pull + turning
    kick, drift = step * pull, step * first
    # The velocities select the periodic image: particles may cross the box within a step.
    way = step * (first + last) / 2
    moved = way + box.displacement(torch.from_numpy(after.position - way), torch.from_numpy(before.position)).numpy()
    # Remainders, at the last moment, of the Taylor expansion about the first moment.
    jump, turn = step * (last - first) - step * kick, step * (step * last_pull - kick)
    miss = moved - drift - step * kick / 2
    position = before.position + theta * (drift + theta * (step * kick / 2 + theta * (
        10 * miss - 4 * jump + turn / 2 + theta * (-15 * miss + 7 * jump - turn + theta * (
            6 * miss - 3 * jump + turn / 2)))))
    velocity = _cubic(before.velocity, after.velocity, step * before.acceleration, step * after.acceleration, theta)
    density = None if before.density is None else torch.from_numpy(_cubic(
        before.density, after.density, step * before.density_rate, step * after.density_rate, theta))
    ids = torch.arange(before.first, before.first + len(position))
    return ParticleSet(ids, box.wrap(torch.from_numpy(position)), torch.from_numpy(velocity), density)


def _cubic(first: np.ndarray, last: np.ndarray, rise: np.ndarray, fall: np.ndarray, theta: float) -> np.ndarray:
    """Value at 0 <= theta <= 1 of the cubic polynomial with the values `first` and `last` at 0 and 1, and the slopes
    `rise` and `fall` there."""
    jump, turn = last - first - rise, fall - rise
    return first + theta * (rise + theta * (3 * jump - turn + theta * (turn - 2 * jump)))
