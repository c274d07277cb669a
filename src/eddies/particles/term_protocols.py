"""What a term of the particle equations must offer."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol, runtime_checkable

from torch import Tensor

from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet

if TYPE_CHECKING:
    from eddies.particles.surroundings import LocalParticles


class PairTerm(Protocol):
    """A sum over neighbours. `cutoff` > 0; `reads`: columns it needs; `width`: numbers held for a pair."""

    cutoff: float
    reads: Sequence[str]
    width: int

    def __call__(self, pairs: Pairs, columns: dict[str, Tensor]) -> dict[str, Tensor]:
        """Rates (count, ...) of "velocity" and perhaps "density"; nothing from pairs beyond the cutoff."""


@runtime_checkable
class MutualPairTerm(PairTerm, Protocol):
    """A sum over neighbours whose two halves of a pair follow from one evaluation, where `mutual` is true.

    What particle i gets from j is `pair_values` of the pair (i, j); what j gets from i is the same times `parity`,
    which is 1 or -1 for each component.
    """

    mutual: bool
    parity: Tensor

    def pair_values(self, pairs: Pairs, columns: dict[str, Tensor]) -> Tensor:
        """What is summed over neighbours, (components, m)."""

    def rates(self, sums: Tensor) -> dict[str, Tensor]:
        """Rates as of a call, from the sums (components, count)."""


class BodyTerm(Protocol):
    """An acceleration of each particle by itself or by all together. `cutoff` = 0."""

    cutoff: float
    reads: Sequence[str]

    def __call__(self, position: Tensor, velocity: Tensor) -> Tensor:
        """Acceleration (n, 3) of the owned particles; may be collective."""


class DensityClosure(Protocol):
    """Gives the density instead of its rate. `cutoff`: how far it looks; `reads`: ghost columns it needs."""

    cutoff: float
    reads: Sequence[str]

    def fields(self, particles: ParticleSet, local: LocalParticles) -> dict[str, Tensor]:
        """The "density" (n,) of the owned particles, and perhaps "velocity", a rate (n, 3) with it; collective."""
