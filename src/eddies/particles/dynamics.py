"""Rates of change of a particle set: the sum of its terms."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.surroundings import LocalParticles, Surroundings
from eddies.particles.term_protocols import BodyTerm, DensityClosure, MutualPairTerm, PairTerm

# Numbers held at once while pairs are summed without a gradient: about a core's cache, or a part of a
# device's memory.
PAIR_VALUES_TOGETHER = {"cpu": 1 << 19, "cuda": 1 << 26}


class ParticleDynamics:
    """The right-hand side of the particle equations, Eq. 3: used unchanged by training and by simulation.

    Parameters
    ----------
    decomposition : slabs, with the communicator.
    box_length : side of the periodic box.
    terms : pair terms (`cutoff` > 0) and body terms; may be empty. Without a pair term or closure there is no
        neighbour list, no halo, and particles do not change rank.
    skin : extra radius of list and halo; they are built anew when some particle has moved by half of it.
    closure : gives the density, where it has no rate of its own; or None.
    dtype : precision of pair arithmetic; that of positions unless given. Positions stay in double precision,
        and pair displacements are converted after the nearest image is taken.
    fixed_ranks : particles never change rank, nor rows; for a few steps of which gradients are taken. The halo
        is as much wider as they stray from their slab.

    Only columns that some pair term or the closure reads travel to other ranks, no farther than the largest
    cutoff plus the skin.
    """

    def __init__(
        self,
        decomposition: SlabDecomposition,
        box_length: float,
        terms: Sequence[PairTerm | BodyTerm],
        skin: float,
        closure: DensityClosure | None = None,
        dtype: torch.dtype | None = None,
        fixed_ranks: bool = False,
    ) -> None:
        self.fixed_ranks = fixed_ranks
        self.box = PeriodicBox(box_length)
        self.pair_terms: list[PairTerm] = [term for term in terms if term.cutoff > 0]
        self.body_terms: list[BodyTerm] = [term for term in terms if term.cutoff == 0]
        self.closure, self.dtype = closure, dtype
        self._mutual = all(isinstance(term, MutualPairTerm) and term.mutual for term in self.pair_terms)
        self._pair_reads = {name for term in self.pair_terms for name in term.reads}
        self._travelling = self._pair_reads
        if closure is not None:
            self._travelling = self._pair_reads - {"density"} | set(closure.reads)
        list_cutoff = max((term.cutoff for term in self.pair_terms), default=0.0)
        halo_cutoff = max(list_cutoff, closure.cutoff if closure else 0.0)
        self.surroundings: Surroundings | None = None
        if halo_cutoff > 0:
            self.surroundings = Surroundings(decomposition, box_length, list_cutoff, halo_cutoff, skin)

    def forget(self) -> None:
        """Build halo and list anew at the next occasion.

        A run that does so wherever it writes a checkpoint goes on bit for bit as one that starts from it.
        """
        if self.surroundings is not None:
            self.surroundings.forget()

    def settle(
        self, particles: ParticleSet, companions: dict[str, Tensor] | None = None
    ) -> tuple[ParticleSet, dict[str, Tensor]]:
        """Bring particles to the ranks of their slabs, where halo and list must be built anew.

        To be called at the beginning of a step. `companions` are further columns (n, ...) that move with the
        particles. Where a gradient is being recorded nothing changes rank, since that would cut it off.
        Collective.
        """
        companions = companions or {}
        if self.fixed_ranks:
            return particles, companions
        if self.surroundings is None:
            return replace(particles, position=self.box.wrap(particles.position)), companions
        columns = vars(particles).values()
        recorded = torch.is_grad_enabled() and any(column.requires_grad for column in columns)
        if not recorded and self.surroundings.due(particles):
            prefix = "companion "
            named = {prefix + name: column for name, column in companions.items()}
            columns = self.surroundings.settle({**vars(particles), **named})
            particles = ParticleSet(**{name: columns[name] for name in vars(particles)})
            companions = {name: columns[prefix + name] for name in companions}
            self.surroundings.forget()
        return particles, companions

    def rates(self, particles: ParticleSet, rows: Tensor | None = None) -> dict[str, Tensor]:
        """Rates of change of the owned particles, or of `rows` (k,) of them; collective, differentiable.

        Returns "velocity", the acceleration (n, 3); "density", the rate of the density (n,), if a term gives
        one; "closure_density" (n,) over all owned particles, if there is a closure.
        """
        kept = slice(None) if rows is None else rows
        rates: dict[str, Tensor] = {}
        given: dict[str, Tensor] = {}
        if self.surroundings is not None:
            self.surroundings.update(particles)
            local = self.surroundings.local(particles, self._travelling)
            if self.closure is not None:
                given = self.closure.fields(particles, local)
                rates["closure_density"] = given["density"]
                if "density" in self._pair_reads:
                    local.columns["density"] = self.surroundings.column(given["density"])
            if self.pair_terms:
                rates |= self._pair_rates(local, len(particles), rows, particles.velocity.dtype)
        acceleration = rates.get("velocity", torch.zeros_like(particles.velocity[kept]))
        if "velocity" in given:
            acceleration = acceleration + given["velocity"][kept]
        for term in self.body_terms:
            acceleration = acceleration + term(particles.position, particles.velocity)[kept]
        return {**rates, "velocity": acceleration}

    def _pair_rates(
        self, local: LocalParticles, owned: int, rows: Tensor | None, dtype: torch.dtype
    ) -> dict[str, Tensor]:
        """The sums over neighbours, converted to `dtype`."""
        receivers = local.position[:owned]
        if rows is None and self._mutual:
            return {name: rate.to(dtype) for name, rate in self._mutual_rates(local, receivers).items()}
        blocks = []
        for block in self._blocks(rows, receivers.device):
            pairs = self.surroundings.neighbors.pairs(receivers, local.position, block, self.dtype)
            blocks.append(self._sum_of_terms(pairs, local.columns))
        return {name: torch.cat([block[name] for block in blocks]).to(dtype) for name in blocks[0]}

    def _mutual_rates(self, local: LocalParticles, receivers: Tensor) -> dict[str, Tensor]:
        """The sums over neighbours, each pair of owned particles evaluated once; those with ghosts on both sides."""
        dtype = self.dtype or receivers.dtype
        totals = [receivers.new_zeros((len(term.parity), len(receivers)), dtype=dtype) for term in self.pair_terms]
        for block in self._blocks(None, receivers.device):
            pairs = self.surroundings.neighbors.pairs(receivers, local.position, block, dtype, once=True)
            for term, total in zip(self.pair_terms, totals):
                pairs.add_to_both(term.pair_values(pairs, local.columns), term.parity.to(total), total)
        return _added(term.rates(total) for term, total in zip(self.pair_terms, totals))

    def _sum_of_terms(self, pairs: Pairs, columns: dict[str, Tensor]) -> dict[str, Tensor]:
        return _added(term(pairs, columns) for term in self.pair_terms)

    def _blocks(self, rows: Tensor | None, device: torch.device) -> Iterator[Tensor | slice | None]:
        """Receivers to take together: few enough for the cache, or all where a gradient is recorded."""
        if rows is not None or torch.is_grad_enabled():
            yield rows
            return
        yield from self.surroundings.neighbors.blocks(
            pairs_together(max(term.width for term in self.pair_terms), device))


def pairs_together(width: int, device: torch.device) -> int:
    """How many pairs to take together where `width` numbers are held for each."""
    return max(PAIR_VALUES_TOGETHER[device.type] // width, 1)


def _added(rates: Iterable[dict[str, Tensor]]) -> dict[str, Tensor]:
    total: dict[str, Tensor] = {}
    for each in rates:
        for name, rate in each.items():
            total[name] = total[name] + rate if name in total else rate
    return total
