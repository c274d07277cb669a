"""What a rank sees around its particles: ghosts and the neighbour list, kept up to date."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError, HaloExchange, require_thick_slabs
from eddies.parallel.migration import migrate
from eddies.parallel.reduction import any_rank, global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.exchanges import exchange_ghost_positions, exchange_ghosts
from eddies.particles.faults import find_unplaced
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.periodic_box import PeriodicBox


@dataclass(frozen=True)
class LocalParticles:
    """The particles a rank sees at one moment: its own rows, then the ghosts.

    Parameters
    ----------
    position : (s, 3); on several ranks z is not periodic here, and ghosts stand where they are seen from.
    neighborhood : whose rows these are.
    halo : for further columns, with `ghosts.exchange_ghosts`; another one whenever rows of ghosts change.
    box : the box in which differences of these positions are taken.
    """

    position: Tensor
    neighborhood: Neighborhood
    halo: HaloExchange
    box: PeriodicBox

    @property
    def neighbors(self) -> NeighborList:
        """The list of pairs of these rows."""
        return self.neighborhood.neighbors


class Neighborhood:
    """Halo and neighbour list of the particles of a decomposition.

    Parameters
    ----------
    decomposition : slabs.
    length : side of the periodic box.
    cutoff : radius of the neighbour list, and how far a rank sees beyond its particles.
    skin : extra radius. They hold until some particle of any rank has moved by half of it.

    All methods are collective. Raises HaloError, on all ranks, when slabs are thinner than the halo.
    """

    def __init__(self, decomposition: SlabDecomposition, length: float, cutoff: float, skin: float) -> None:
        self.decomposition, self.cutoff, self.skin = decomposition, cutoff, skin
        self.box = PeriodicBox(length, periodic_z=decomposition.size == 1)
        self._neighbors = NeighborList(self.box, cutoff, skin)
        self._seen: Tensor | None = None
        self.builds = 0
        self.forget()

    def forget(self) -> None:
        """Build anew at the next occasion."""
        self._ids: Tensor | None = None

    def built_at(self, particles: ParticleSet) -> Tensor | None:
        """Positions (n, 3) of these particles when they were built; None if that was for others. Sends nothing."""
        return self._built_at if particles.id is self._ids else None

    def outdated(self, particles: ParticleSet) -> bool:
        """Whether, on any rank, these are other particles or one has moved by more than half the skin, or to a
        position that is not a number."""
        return any_rank(self.decomposition.comm, not self._moved(particles) <= self.skin / 2)

    def _moved(self, particles: ParticleSet) -> float:
        """Largest distance that a particle of this rank has moved since the build; infinite for others."""
        if particles.id is not self._ids:
            return math.inf
        moved = self.box.displacement(particles.position.detach(), self._built_at)
        return math.sqrt(float((moved * moved).sum(-1).max())) if len(moved) else 0.0

    def update(self, particles: ParticleSet) -> None:
        """Make halo and list fit the particles.

        No particle changes rank: where one has left its slab, the halo is wider by the farthest it strayed, and slabs
        must be thicker by twice that: into one slab particles may stray from both sides, whose ranks do not see each
        other. Raises HaloError, on all ranks, where slabs are too thin, a position is not finite, or a particle is
        farther outside its slab than the box is long.
        """
        if not self.outdated(particles):
            return
        strayed = farthest_outside(self.decomposition, particles)
        width = self.cutoff + self.skin + strayed
        require_thick_slabs(self.decomposition, width + strayed)
        self.halo = HaloExchange(self.decomposition, as_numpy(particles.position), width)
        self._ids, self._built_at = particles.id, particles.position.detach().clone()
        self.builds += 1
        with torch.no_grad():
            self._seen = self._with_ghosts(particles.position, exchange_ghost_positions)

    @property
    def neighbors(self) -> NeighborList:
        """The list of pairs, which is built where somebody asks for it."""
        if self._seen is not None:
            self._neighbors.build(self._seen[: len(self._built_at)], self._seen, exclude_self=True)
            self._seen = None
        return self._neighbors

    def local(self, position: Tensor) -> LocalParticles:
        """Positions (n, 3) of the owned particles with ghosts, as of now."""
        # Stored component by component, as the gathering of pairs wants it.
        position = self._with_ghosts(position, exchange_ghost_positions).T.contiguous().T
        return LocalParticles(position, self, self.halo, self.box)

    def column(self, owned: Tensor) -> Tensor:
        """A column (n, ...) of owned particles followed by its ghost rows."""
        return self._with_ghosts(owned, exchange_ghosts)

    def _with_ghosts(self, owned: Tensor, exchange) -> Tensor:
        return owned if self.decomposition.size == 1 else torch.cat([owned, exchange(self.halo, owned)])


def farthest_outside(slab: SlabDecomposition, particles: ParticleSet) -> float:
    """How far the particle farthest from its slab, of all ranks, is outside it; collective.

    Raises HaloError, on all ranks, where that is farther than the box is long, or a position is not finite.
    """
    position = particles.position.detach()
    z = position[:, 2]
    distance = torch.maximum(slab.lower - z, z - slab.upper).clamp_min(0)
    if slab.size == 1:  # which has no outside
        distance = torch.zeros_like(z)
    # What is just at the upper face belongs to the next slab.
    distance = torch.where(z == slab.upper, torch.finfo(z.dtype).tiny, distance)
    distance = distance.where(torch.isfinite(position).all(1), torch.inf)
    farthest = float(global_max(slab.comm, float(distance.max()) if len(distance) else 0.0))
    if farthest > slab.length:
        found = find_unplaced(particles, distance, PeriodicBox(slab.length), slab.comm.rank)
        raise HaloError(f"within the step, {first_complaint(slab.comm, found)}")
    return farthest


def at_home(decomposition: SlabDecomposition, columns: dict[str, Tensor], reach: float) -> dict[str, Tensor]:
    """All columns after each particle moved to the rank of its slab, ordered by place in cells of side `reach` and then
    by id; collective.

    The order depends on nothing but ids and positions of a rank, and keeps neighbours close in memory.
    """
    device = columns["id"].device
    moved = migrate(decomposition, {name: as_numpy(column) for name, column in columns.items()})
    ids = moved["id"]
    numbers = int(ids.max(initial=0)) + 1
    # Not so many that a cell and an id no longer fit one number, by which to sort is much faster than by four.
    cells = max(min(int(decomposition.length / reach), int((2**63 / numbers) ** (1 / 3)) - 1), 1)
    x, y, z = np.minimum((moved["position"].T * (cells / decomposition.length)).astype(np.int64), cells - 1)
    order = np.argsort(((z * cells + y) * cells + x) * numbers + ids)
    return {name: torch.from_numpy(np.take(column, order, axis=0)).to(device) for name, column in moved.items()}
