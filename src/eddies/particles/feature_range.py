"""Range of the inputs on which a network was trained, and the share of later inputs outside this range."""

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
    """Yield the inputs of all networks of a model in blocks (features, m) of pairs; collective.

    `particles` must have the density that the model's terms read. Each rank yields at least one block. Each pair
    appears in both orders, on the rank that owns its first particle. So counts do not depend on the number of ranks.
    """
    terms = dynamics.model.networks
    context = dynamics.context(particles, density=particles.density)
    for pairs in context.pairs_in_blocks(max(term.width for term in terms)):
        yield torch.cat([term.features(pairs) for term in terms])


@dataclass(frozen=True)
class FeatureRange:
    """Smallest and largest value, both (features,), of each input of the networks over all pairs in the training.

    Outside this range the network extrapolates: its values are smooth but were never compared with the truth.
    """

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, comm: Comm, blocks: Iterable[Tensor]) -> FeatureRange:
        """Find the range over the blocks (features, m) of all ranks; collective. Each rank must have a block."""
        low, high = zip(*map(_extrema, blocks))
        return cls(global_min(comm, np.min(low, axis=0)), global_max(comm, np.max(high, axis=0)))

    def share_outside(self, comm: Comm, blocks: Iterable[Tensor]) -> float:
        """Share of the pairs that have a NaN or a feature outside the range; zero if there are no pairs. Collective.

        `blocks` (features, m) hold the pairs of this rank, and the share is that of the pairs of all ranks.
        """
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
