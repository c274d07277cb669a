"""Rates of change of a particle set: its model, with the halo and the neighbour list that this needs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import Context
from eddies.particles.model import LagrangianModel, LinearRates
from eddies.particles.neighborhood import Neighborhood, at_home, farthest_outside
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates
from eddies.particles.surroundings import Surroundings

if TYPE_CHECKING:
    from eddies.particles.resolved_velocity import ResolvedVelocity


class ParticleDynamics:
    """The right-hand side of the particle equations, Eq. 3: used unchanged by training and by simulation.

    Parameters
    ----------
    decomposition : slabs, with the communicator.
    model : the terms. If none of them reads pairs or the resolved velocity there is no neighbour list, no halo, and
        particles do not change rank.
    skin : extra radius of list and halo; they are built anew when some particle has moved by half of it.
    dtype : precision of pair arithmetic, and of fields and modes of the resolved velocity; that of positions unless
        given. Positions stay in double precision, and pair displacements are converted after the nearest image is
        taken.
    fixed_ranks : particles never change rank, nor rows; for a few steps of which gradients are taken. The halo
        is as much wider as they stray from their slab.
    drift : how far they may stray then, where the resolved velocity is asked for.

    `time` is that at the beginning of the step that is being taken; integrators move it on.
    """

    def __init__(self, decomposition: SlabDecomposition, model: LagrangianModel, skin: float,
                 dtype: torch.dtype | None = None, fixed_ranks: bool = False, drift: float = 0.0) -> None:
        self.decomposition, self.model, self.dtype, self.fixed_ranks = decomposition, model, dtype, fixed_ranks
        self.box, self.time, self.evaluations = PeriodicBox(decomposition.length), 0.0, 0
        self.resolution: ResolvedVelocity | None = None
        self.neighborhood: Neighborhood | None = None
        self._surroundings: Surroundings | None = None
        if "resolved" in model.reads:
            from eddies.particles import resolved_velocity  # pyfftw, where a transform is needed
            self.resolution = resolved_velocity.ResolvedVelocity.on_slabs(decomposition, model.flow, skin / 2 + drift,
                                                                          dtype)
        if "pairs" in model.reads:
            self.neighborhood = Neighborhood(decomposition, decomposition.length, model.flow.cutoff, skin)

    def forget(self) -> None:
        """Build halo and list anew at the next occasion.

        A run that does so wherever it writes a checkpoint goes on bit for bit as one that starts from it.
        """
        self.release()
        if self.neighborhood is not None:
            self.neighborhood.forget()

    def release(self) -> None:
        """Let the memory go of what the places of the particles last seen tell."""
        self._surroundings = None

    def built_at(self, particles: ParticleSet) -> Tensor | None:
        """Positions (n, 3) of these particles when halo and list were built for them; None without such."""
        return None if self.neighborhood is None else self.neighborhood.built_at(particles)

    def rebuild(self, particles: ParticleSet, built_at: Tensor) -> None:
        """Have halo and list as they were built for these particles at other positions (n, 3); collective."""
        if self.neighborhood is not None:
            self.forget()
            self.neighborhood.update(replace(particles, position=built_at))

    def begin(self) -> None:
        """Time 0 of a run of which nothing is known yet."""
        self.time, self.evaluations = 0.0, 0
        if self.resolution is not None:
            self.resolution.forget()

    def state_dict(self) -> dict[str, Tensor]:
        """What evaluations to come depend on beside the particles: the time, and what the closure foresees."""
        resolved = {} if self.resolution is None else self.resolution.state_dict()
        return {"time": torch.tensor(self.time, dtype=torch.float64), **resolved}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`, on the same number of ranks."""
        self.time = float(state["time"])
        if self.resolution is not None:
            self.resolution.load_state_dict(state)

    def settle(
        self, particles: ParticleSet, companions: dict[str, Tensor] | None = None
    ) -> tuple[ParticleSet, dict[str, Tensor]]:
        """Bring particles to the ranks of their slabs, where halo and list must be built anew.

        It is called before rates are asked for. `companions` are further columns (n, ...) that move with the
        particles. Nothing changes rank where a gradient is being recorded, since that would cut it off.
        Collective.
        """
        companions = companions or {}
        if self.fixed_ranks:
            return particles, companions
        if self.neighborhood is None and (self.resolution is None or self.decomposition.size == 1):
            if self.resolution is not None:
                farthest_outside(self.decomposition, particles)
            return replace(particles, position=self.box.wrap(particles.position)), companions
        columns = particles.columns()
        recorded = torch.is_grad_enabled() and any(column.requires_grad for column in columns.values())
        if not recorded and self._away(particles):
            prefix = "companion "
            named = {prefix + name: column for name, column in companions.items()}
            reach = self.model.flow.cutoff if self.neighborhood else self.decomposition.spacing
            moved = at_home(self.decomposition, {**columns, **named}, reach)
            particles = ParticleSet(**{name: moved[name] for name in columns})
            companions = {name: moved[prefix + name] for name in companions}
        return particles, companions

    def _away(self, particles: ParticleSet) -> bool:
        """Whether halo and list no longer fit the particles, or, where there are none, one is out of its slab."""
        if self.neighborhood is not None:
            return self.neighborhood.outdated(particles)
        return farthest_outside(self.decomposition, particles) > 0

    def rates(self, particles: ParticleSet, rows: Tensor | None = None,
              kept: Mapping[str, LinearRates] | None = None, density: Tensor | None = None,
              time: float | None = None) -> Rates:
        """Rates of change of the owned particles, or of `rows` (k,) of them: see LagrangianModel.rates.

        `kept` stands for terms at these very particles; `density` (n,) for that which terms would give. At a `time` of
        a run its evaluations before tell what to expect; without one the moment stands alone.
        """
        return self.model.rates(self.context(particles, rows, density, time), kept)

    def rates_after(self, delay: float, particles: ParticleSet) -> Rates:
        """The same within a step, a time after its beginning; later evaluations expect what follows from it."""
        context = self.context(particles, time=self.time + delay)
        rates = self.model.rates(context)
        if self.resolution is not None:
            self.resolution.remember(self.time + delay, context.resolved, rates.force_modes)
        self.evaluations += 1
        return rates

    def context(self, particles: ParticleSet, rows: Tensor | None = None, density: Tensor | None = None,
                time: float | None = None) -> Context:
        """What terms are evaluated in at these particles; collective."""
        if self.neighborhood is not None:
            self.neighborhood.update(particles)
            if self._surroundings is None or not self._surroundings.fit(particles.position):
                self._surroundings = Surroundings(particles.position, self.neighborhood, self.model.flow,
                                                  self.dtype or particles.position.dtype)
        if density is None and not self.model.density_is_given:
            density = particles.density
        return Context(self.decomposition, particles, self.model.flow, self._surroundings, self.resolution, rows,
                       self.dtype, density, time)
