"""Rates of change of a particle set: its model, with the halo and the neighbour list that this needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import Context
from eddies.particles.model import LagrangianModel, LinearRates
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates
from eddies.particles.surroundings import Surroundings


class ParticleDynamics:
    """The right-hand side of the particle equations, Eq. 3: used unchanged by training and by simulation.

    Parameters
    ----------
    decomposition : slabs, with the communicator.
    model : the terms. If none of them reads pairs or the resolved velocity there is no neighbour list, no halo, and
        particles do not change rank.
    skin : extra radius of list and halo; they are built anew when some particle has moved by half of it.
    dtype : precision of pair arithmetic; that of positions unless given. Positions stay in double precision,
        and pair displacements are converted after the nearest image is taken.
    drift : how far particles may move beyond half the skin before they change rank: the reach of the grid of the
        resolved velocity.
    fixed_ranks : particles never change rank, nor rows; for a few steps of which gradients are taken. The halo
        is as much wider as they stray from their slab.
    """

    def __init__(self, decomposition: SlabDecomposition, model: LagrangianModel, skin: float,
                 dtype: torch.dtype | None = None, drift: float = 0.0, fixed_ranks: bool = False) -> None:
        self.decomposition, self.model, self.dtype, self.fixed_ranks = decomposition, model, dtype, fixed_ranks
        self.box = PeriodicBox(decomposition.length)
        reads = model.reads
        list_cutoff = model.flow.cutoff if "pairs" in reads else 0.0
        self.resolution = None
        if "resolved" in reads:
            from eddies.particles.resolved_velocity import ResolvedVelocity  # pyfftw, where a transform is needed
            self.resolution = ResolvedVelocity.on_slabs(decomposition, dtype or torch.float64, skin, drift)
        reach = max(list_cutoff, self.resolution.reach if self.resolution else 0.0)
        self.surroundings: Surroundings | None = None
        if reach > 0:
            self.surroundings = Surroundings(decomposition, decomposition.length, list_cutoff, reach, skin)

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
        columns = particles.columns()
        recorded = torch.is_grad_enabled() and any(column.requires_grad for column in columns.values())
        if not recorded and self.surroundings.due(particles):
            prefix = "companion "
            named = {prefix + name: column for name, column in companions.items()}
            moved = self.surroundings.settle({**columns, **named})
            particles = ParticleSet(**{name: moved[name] for name in columns})
            companions = {name: moved[prefix + name] for name in companions}
            self.surroundings.forget()
        return particles, companions

    def rates(self, particles: ParticleSet, rows: Tensor | None = None,
              kept: Mapping[str, LinearRates] | None = None, density: Tensor | None = None) -> Rates:
        """Rates of change of the owned particles, or of `rows` (k,) of them: see LagrangianModel.rates.

        `kept` stands for terms at these very particles; `density` (n,) for that which terms would give.
        """
        return self.model.rates(self.context(particles, rows, density), kept)

    def context(self, particles: ParticleSet, rows: Tensor | None = None, density: Tensor | None = None) -> Context:
        """What terms are evaluated in at these particles; collective."""
        if self.surroundings is not None:
            self.surroundings.update(particles)
        if density is None and not self.model.density_is_given:
            density = particles.density
        return Context(self.decomposition, particles, self.model.flow, self.surroundings, self.resolution, rows,
                       self.dtype, density)
