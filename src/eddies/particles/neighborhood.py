"""Neighbour lists, and the surroundings of a rank's particles: ghosts, list and kriging weights, kept up to date."""

from __future__ import annotations

import math
from collections.abc import Iterator
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.neighbors import neighbors_within, pairs_within
from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError, HaloExchange, require_thick_slabs
from eddies.parallel.migration import Migration
from eddies.parallel.reduction import any_rank, global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import kernels_serve
from eddies.particles.exchanges import redistributed, with_ghosts
from eddies.particles.faults import find_unplaced
from eddies.particles.kriging import Kriging
from eddies.particles.pairs import Pairs, gather_rows
from eddies.particles.particle_set import ParticleSet, as_numpy
from eddies.particles.periodic_box import PeriodicBox, safe_norm


class NeighborList:
    """All senders within `cutoff` + `skin` of each receiver.

    The list is in compressed rows: the senders of receiver i are `senders[offsets[i]:offsets[i + 1]]`. If i and j are
    both receivers and senders, the list holds both (i, j) and (j, i), or neither.

    Parameters
    ----------
    box : the periodic box.
    cutoff : radius within which pairs interact.
    skin : extra radius. The list remains valid until a particle has moved by `skin`/2.

    Raises ValueError unless `cutoff` is positive, `skin` is not negative, and their sum is less than half the box. Only
    within half the box are nearest images unique.
    """

    def __init__(self, box: PeriodicBox, cutoff: float, skin: float) -> None:
        if not (cutoff > 0 and skin >= 0 and cutoff + skin < box.length / 2):
            raise ValueError(f"cutoff {cutoff:.6g} and skin {skin:.6g}: the cutoff must be positive, and their sum "
                             f"less than half the box, {box.length / 2:.6g}")
        self.box, self.cutoff, self.skin = box, cutoff, skin

    def build(self, receivers: Tensor, senders: Tensor, exclude_self: bool) -> None:
        """List the pairs of receivers (n, 3) and senders (s, 3).

        With `exclude_self`, receiver i and sender i are one particle, which is not its own neighbour. Raises ValueError
        if a position is not finite.
        """
        if not (torch.isfinite(receivers).all() and torch.isfinite(senders).all()):
            raise ValueError("neighbour list: a position is not finite")
        # The radius is slightly larger, so that `pairs` alone decides which pairs count: alike for (i, j) and (j, i).
        reach = (self.cutoff + self.skin) * (1 + 1e-9)
        columns = neighbors_within(self.box, reach, as_numpy(receivers), as_numpy(senders), exclude_self)
        self.offsets, self.senders = (torch.from_numpy(column).to(receivers.device) for column in columns)

    def blocks(self, together: int) -> Iterator[slice]:
        """Yield slices of receivers, each with about `together` listed pairs; without receivers, one empty slice."""
        ends = self.offsets[1:]
        if not len(ends):
            yield slice(0, 0)
            return
        targets = torch.arange(together, int(ends[-1]) + together, together, device=ends.device)
        full = torch.unique(torch.searchsorted(ends, targets, right=True)).tolist()
        bounds = [0, *(row for row in full if 0 < row < len(ends)), len(ends)]
        for first, last in zip(bounds[:-1], bounds[1:]):
            yield slice(first, last)

    def pairs(self, receivers: Tensor, senders: Tensor, rows: Tensor | slice | None = None,
              dtype: torch.dtype | None = None) -> Pairs:
        """Return the pairs that lie within the cutoff at these positions; differentiable in the positions.

        Parameters
        ----------
        receivers, senders : (n, 3) and (s, 3), present positions of the particles that the list was built from.
        rows : receivers to keep, as row numbers (k,) or a slice. Output row i belongs to the i-th of them.
        dtype : type of displacement and distance; by default the type of the positions. Positions are
            subtracted before the conversion, so the size of the box costs no accuracy in single precision.
        """
        dtype, total = dtype or receivers.dtype, len(self.offsets) - 1
        numbers = (rows if isinstance(rows, Tensor) else
                   torch.arange(total, device=receivers.device)[rows or slice(None)])
        recorded = torch.is_grad_enabled() and (receivers.requires_grad or senders.requires_grad)
        if kernels_serve(receivers.device) and not recorded:
            return self._compiled_pairs(receivers, senders, numbers, dtype)
        receiver, segment, sender = self._listed(numbers)
        with torch.no_grad():
            square = sum(component.square() for component in self._difference(receivers, senders, receiver, sender))
            near = torch.nonzero(square < self.cutoff**2).squeeze(1)
        receiver, segment, sender = (index.index_select(0, near) for index in (receiver, segment, sender))
        components = self._difference(receivers, senders, receiver, sender)
        displacement = torch.stack([component.to(dtype) for component in components])
        return Pairs(receiver, segment, sender, displacement.T, safe_norm(displacement), len(numbers))

    def _compiled_pairs(self, receivers: Tensor, senders: Tensor, numbers: Tensor, dtype: torch.dtype) -> Pairs:
        kind = np.dtype(str(dtype).removeprefix("torch."))
        columns = pairs_within(self.box, self.cutoff, as_numpy(receivers), as_numpy(senders),
                               self.offsets.numpy(), self.senders.numpy(), numbers.numpy(), kind)
        receiver, segment, sender, displacement, distance = map(torch.from_numpy, columns)
        return Pairs(receiver, segment, sender, displacement.T, distance, len(numbers))

    def _difference(self, receivers: Tensor, senders: Tensor, receiver: Tensor, sender: Tensor) -> list[Tensor]:
        """Components of x_i - x_j between nearest images. Single components are faster than (m, 3) rows."""
        return [self.box.nearest_image(x.index_select(0, receiver) - y.index_select(0, sender), axis)
                for axis, (x, y) in enumerate(zip(receivers.unbind(1), senders.unbind(1)))]

    def _listed(self, numbers: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Receiver, output row and sender of each listed pair of the receivers `numbers` (k,). The output row of a pair
        is the index of its receiver in `numbers`."""
        length = self.offsets[numbers + 1] - self.offsets[numbers]
        segment = torch.repeat_interleave(torch.arange(len(numbers), device=numbers.device), length)
        shift = self.offsets[numbers] - (length.cumsum(0) - length)
        listed = gather_rows(shift, segment) + torch.arange(len(segment), device=numbers.device)
        return numbers[segment], segment, self.senders[listed]


class LocalParticles:
    """The particles that a rank sees at one moment, and quantities that depend on their positions alone.

    Evaluations at the same positions share these quantities. Each is computed at its first use; all are collective.
    """

    def __init__(self, owned: Tensor, neighborhood: Neighborhood) -> None:
        self._owned, self.neighborhood = owned, neighborhood
        self._state = self._state_of(owned)
        self._kriging: Kriging | None = None

    def fit(self, owned: Tensor) -> bool:
        """Whether these quantities are still valid for the positions `owned`. All ranks get the same answer.

        They are valid until the tensor of positions, the halo or the list changes, or until the recording of gradients
        begins or ends."""
        return self._owned is owned and self._state == self._state_of(owned)

    def _state_of(self, owned: Tensor) -> tuple[int, int, bool]:
        return owned._version, self.neighborhood.builds, torch.is_grad_enabled() and owned.requires_grad

    @cached_property
    def position(self) -> Tensor:
        """Positions (s, 3) of the owned particles, then of the ghosts.

        On several ranks z is not periodic here: the z of ghosts beyond the periodic face is shifted by one period.
        """
        # Stored component by component, which is faster for the gathering of pairs.
        return with_ghosts(self.neighborhood.halo, self._owned, positions=True).T.contiguous().T

    @property
    def neighbors(self) -> NeighborList:
        return self.neighborhood.neighbors

    def kriging(self, filter_width: float, dtype: torch.dtype) -> Kriging:
        """Kriging among neighbours at all owned particles, for fields that have passed a filter of this width."""
        if self._kriging is None:
            position = self.position.detach()
            pairs = self.neighbors.pairs(position[: len(self._owned)], position, dtype=dtype)
            self._kriging = Kriging(pairs, len(position), self.neighborhood.cutoff, filter_width,
                                    self.neighborhood.column)
        return self._kriging


class Neighborhood:
    """Halo and neighbour list of the particles of a decomposition. All methods are collective.

    Parameters
    ----------
    decomposition : slabs.
    cutoff : radius of the neighbour list. A rank sees all particles up to this distance from its own.
    skin : extra radius. Halo and list are valid until some particle of any rank has moved by half of it.
    """

    def __init__(self, decomposition: SlabDecomposition, cutoff: float, skin: float) -> None:
        self.decomposition, self.cutoff, self.skin = decomposition, cutoff, skin
        self.box = PeriodicBox(decomposition.length, periodic_z=decomposition.size == 1)
        self._neighbors = NeighborList(self.box, cutoff, skin)
        self._unlisted: Tensor | None = None
        self.builds = 0
        self.forget()

    def forget(self) -> None:
        """Make the next update rebuild halo and list."""
        self._ids: Tensor | None = None

    def built_at(self, particles: ParticleSet) -> Tensor | None:
        """Positions (n, 3) of these particles at the last build; None if it was for other particles. Not collective."""
        return self._built_at if particles.id is self._ids else None

    def outdated(self, particles: ParticleSet) -> bool:
        """Whether halo and list must be built again. All ranks get the same answer.

        This is so if, on any rank, the last build was for other particles, a particle has moved since by more than half
        the skin, or a position is NaN."""
        distance = math.inf
        if particles.id is self._ids:
            moved = self.box.displacement(particles.position.detach(), self._built_at)
            distance = math.sqrt(float((moved * moved).sum(-1).max())) if len(moved) else 0.0
        return any_rank(self.decomposition.comm, not distance <= self.skin / 2)

    def update(self, particles: ParticleSet) -> None:
        """Rebuild halo and list if they are outdated. No particle changes rank.

        If particles are outside their slabs, the halo is wider by their largest distance from the slab, and slabs must
        be thicker by twice that distance. In thinner slabs a particle of the rank below and one of the rank above could
        be neighbours, and these two ranks exchange no ghosts. Raises HaloError on all ranks if slabs are too thin, a
        position is not finite, or a particle is farther outside its slab than the box is long.
        """
        if not self.outdated(particles):
            return
        outside = farthest_outside(self.decomposition, particles)
        width = self.cutoff + self.skin + outside
        require_thick_slabs(self.decomposition, width + outside)
        self.halo = HaloExchange(self.decomposition, as_numpy(particles.position), width)
        self._ids, self._built_at = particles.id, particles.position.detach().clone()
        self.builds += 1
        with torch.no_grad():
            self._unlisted = with_ghosts(self.halo, particles.position, positions=True)

    @property
    def neighbors(self) -> NeighborList:
        """The neighbour list, built at its first use after an update."""
        if self._unlisted is not None:
            self._neighbors.build(self._unlisted[: len(self._built_at)], self._unlisted, exclude_self=True)
            self._unlisted = None
        return self._neighbors

    def column(self, owned: Tensor) -> Tensor:
        """Column (n, ...) of the owned particles, followed by its ghost rows."""
        return with_ghosts(self.halo, owned)


def farthest_outside(slab: SlabDecomposition, particles: ParticleSet) -> float:
    """Return the largest distance of any particle of any rank from the slab of its rank; collective.

    Raises HaloError on all ranks if the distance exceeds the length of the box or a position is not finite.
    """
    position = particles.position.detach()
    z = position[:, 2]
    distance = torch.maximum(slab.lower - z, z - slab.upper).clamp_min(0)
    if slab.size == 1:  # one slab is the whole periodic box
        distance = torch.zeros_like(z)
    # A particle exactly at the upper face belongs to the next slab.
    distance = torch.where(z == slab.upper, torch.finfo(z.dtype).tiny, distance)
    distance = distance.where(torch.isfinite(position).all(1), torch.inf)
    farthest = float(global_max(slab.comm, float(distance.max()) if len(distance) else 0.0))
    if farthest > slab.length:
        complaint = find_unplaced(particles, distance, PeriodicBox(slab.length), slab.comm.rank)
        raise HaloError(f"in an intermediate stage, {first_complaint(slab.comm, complaint)}")
    return farthest


def at_home(decomposition: SlabDecomposition, columns: dict[str, Tensor], reach: float) -> dict[str, Tensor]:
    """Move each particle to the rank of its slab and sort a rank's particles by cell, then by id.

    `columns` holds at least `id` (n,) and `position` (n, 3); positions are wrapped into the box first. Cells have a
    side of about `reach`, so neighbours are close in memory. The order depends on ids and positions alone.
    Differentiable, collective also in the backward pass.
    """
    columns = {**columns, "position": PeriodicBox(decomposition.length).wrap(columns["position"])}
    # A position that is not finite goes anywhere: the next update of halo and list reports it.
    position = np.nan_to_num(as_numpy(columns["position"]))
    migration = Migration(decomposition, as_numpy(columns["id"]), position)
    ids, position = migration.ids, migration.apply(position)
    numbers = int(ids.max(initial=0)) + 1
    # The number of cells is limited so that cell and id fit one integer: one sort key is much faster than four.
    cells = max(min(int(decomposition.length / reach), int((2**63 / numbers) ** (1 / 3)) - 1), 1)
    x, y, z = np.minimum((position.T * (cells / decomposition.length)).astype(np.int64), cells - 1)
    migration.arrange(np.argsort(((z * cells + y) * cells + x) * numbers + ids))
    return {name: redistributed(migration, column) for name, column in columns.items()}
