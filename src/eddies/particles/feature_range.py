"""Which inputs a network has seen, and how many of those that it is given lie outside of them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max, global_min, global_sum
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_set import ParticleSet


def pair_features(dynamics: ParticleDynamics, particles: ParticleSet) -> Iterator[Tensor]:
    """What the networks of a model are given of particles with the density that it sees, in blocks (features, m), those
    of all networks one after the other; collective, with at least one block on each rank.

    Each pair stands in both orders, on the rank that owns its first particle, also where a term needs one order
    alone: so counts are the same on any number of ranks.
    """
    terms = dynamics.model.networks
    context = dynamics.context(particles, density=particles.density)
    for pairs in context.scaled_pairs(max(term.width for term in terms)):
        yield torch.cat([term.features(pairs) for term in terms])


@dataclass(frozen=True)
class FeatureRange:
    """Smallest and largest value of each input of a network over all pairs that it was trained on, (features,) each.

    Beyond them tanh layers go on smoothly, but what they give was never compared with anything.
    """

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, comm: Comm, blocks: Iterable[Tensor]) -> FeatureRange:
        """The range of blocks (features, m) of all ranks, of which each has at least one; collective."""
        low, high = zip(*map(_extrema, blocks))
        return cls(global_min(comm, np.min(low, axis=0)), global_max(comm, np.max(high, axis=0)))

    def share_outside(self, comm: Comm, blocks: Iterable[Tensor]) -> float:
        """The share of the pairs in blocks (features, m) of all ranks of which some feature lies outside the range, or
        is not a number; collective. Zero without pairs."""
        counts = np.zeros(2, np.int64)
        for block in blocks:
            low, high = (torch.from_numpy(bound).to(block).unsqueeze(1) for bound in (self.low, self.high))
            inside = ((block >= low) & (block <= high)).all(0)
            counts += len(inside) - int(inside.sum()), len(inside)
        outside, total = global_sum(comm, counts)
        return float(outside / max(total, 1))


def _extrema(block: Tensor) -> tuple[np.ndarray, np.ndarray]:
    if block.shape[1] == 0:
        return np.full(len(block), np.inf), np.full(len(block), -np.inf)
    low, high = torch.aminmax(block, dim=1)
    return low.double().cpu().numpy(), high.double().cpu().numpy()
