"""Rates of change of a set of particles: the model with its halo, neighbour list and resolved velocity."""

from collections.abc import Mapping
from dataclasses import replace

import torch
from torch import Tensor

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import Context
from eddies.particles.model import LagrangianModel, LinearRates
from eddies.particles.neighborhood import LocalParticles, Neighborhood, at_home, farthest_outside
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates
from eddies.particles.resolved_velocity import ResolvedVelocity


class ParticleDynamics:
    """The right-hand side of the particle equations, Eq. 3, for training and for simulation.

    Parameters
    ----------
    decomposition : slabs, with the communicator.
    model : the terms. If no term reads pairs or the resolved velocity, there is no neighbour list and no halo, and
        particles do not change rank.
    skin : extra radius of neighbour list and halo. Both are rebuilt when some particle has moved by half the skin.
    dtype : precision of the resolved velocity and of computations with pairs; by default that of the positions.
        Positions stay in double precision; only their differences are converted.

    `time` is the time at the beginning of the present step; integrators advance it.
    """

    def __init__(self, decomposition: SlabDecomposition, model: LagrangianModel, skin: float,
                 dtype: torch.dtype | None = None) -> None:
        self.decomposition, self.model, self.dtype = decomposition, model, dtype
        self.box, self.time, self.evaluations = PeriodicBox(decomposition.length), 0.0, 0
        self.resolution: ResolvedVelocity | None = None
        self.neighborhood: Neighborhood | None = None
        self._local: LocalParticles | None = None
        if "resolved" in model.reads:
            self.resolution = ResolvedVelocity.on_slabs(decomposition, model.flow.scales, skin / 2, dtype)
        if "pairs" in model.reads:
            self.neighborhood = Neighborhood(decomposition, model.flow.cutoff, skin)

    def forget(self) -> None:
        """Make the next evaluation rebuild halo and neighbour list.

        A run that does so at each checkpoint is bitwise equal to a run that continues from the checkpoint.
        """
        self.release()
        if self.neighborhood is not None:
            self.neighborhood.forget()

    def release(self) -> None:
        """Free the memory of quantities that depend on the last positions."""
        self._local = None

    def built_at(self, particles: ParticleSet) -> Tensor | None:
        """Return the positions (n, 3) of these particles at the last build of halo and neighbour list.

        The result is None if the last build was for other particles, or if there is no neighbour list.
        """
        return None if self.neighborhood is None else self.neighborhood.built_at(particles)

    def rebuild(self, particles: ParticleSet, built_at: Tensor) -> None:
        """Build halo and list from `built_at` (n, 3), the positions of these particles at a past build; collective."""
        if self.neighborhood is not None:
            self.forget()
            self.neighborhood.update(replace(particles, position=built_at))

    def begin(self) -> None:
        """Begin a new run at time 0, and discard the predictions of the resolved velocity."""
        self.time, self.evaluations = 0.0, 0
        if self.resolution is not None:
            self.resolution.forget()

    def state_dict(self) -> dict[str, Tensor]:
        """The time, and the modes from which the next resolved velocity is predicted."""
        resolved = {} if self.resolution is None else self.resolution.state_dict()
        return {"time": torch.tensor(self.time, dtype=torch.float64), **resolved}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Inverse of `state_dict`, on the same number of ranks."""
        self.time = float(state["time"])
        if self.resolution is not None:
            self.resolution.load_state_dict(state)

    def settle(self, particles: ParticleSet, *others: ParticleSet) -> list[ParticleSet]:
        """Move particles to the ranks of their slabs if halo and list are outdated; collective.

        With a resolved velocity but no list, particles move if at least one is outside its slab. Integrators call
        `settle` before they evaluate the rates. `others` are further states of the same particles; their rows move with
        the particles. Returns all states. Differentiable, collective also in the backward pass.
        """
        states = [particles, *others]
        if self.neighborhood is None and (self.resolution is None or self.decomposition.size == 1):
            if self.resolution is not None:
                farthest_outside(self.decomposition, particles)
            return [replace(particles, position=self.box.wrap(particles.position)), *others]
        away = (self.neighborhood.outdated(particles) if self.neighborhood is not None
                else farthest_outside(self.decomposition, particles) > 0)
        if not away:
            return states

        def label(number: int, name: str) -> str:
            return f"{name} {number}" if number and name != "id" else name

        columns = {label(number, name): column for number, state in enumerate(states)
                   for name, column in state.columns().items()}
        reach = self.model.flow.cutoff if self.neighborhood else self.decomposition.spacing
        moved = at_home(self.decomposition, columns, reach)
        return [ParticleSet(**{name: moved[label(number, name)] for name in state.columns()})
                for number, state in enumerate(states)]

    def rates(self, particles: ParticleSet, rows: Tensor | None = None, kept: Mapping[str, LinearRates] | None = None,
              density: Tensor | None = None, time: float | None = None) -> Rates:
        """Return the rates of change of the owned particles, or of `rows` (k,) of them; see LagrangianModel.rates.

        `kept` holds stored rates by name of the term; these terms are not evaluated. `density` (n,) replaces the
        density that terms would give. If `time` is given, the solve for the resolved velocity starts from a prediction
        for this time, made from earlier evaluations.
        """
        return self.model.rates(self.context(particles, rows, density, time), kept)

    def rates_after(self, delay: float, particles: ParticleSet) -> Rates:
        """Return the rates at the time `delay` after the beginning of the present step.

        Later predictions of the resolved velocity use this evaluation.
        """
        context = self.context(particles, time=self.time + delay)
        rates = self.model.rates(context)
        if self.resolution is not None:
            self.resolution.remember(self.time + delay, context.resolved, rates.force_modes)
        self.evaluations += 1
        return rates

    def context(self, particles: ParticleSet, rows: Tensor | None = None, density: Tensor | None = None,
                time: float | None = None) -> Context:
        if self.neighborhood is not None:
            self.neighborhood.update(particles)
            if self._local is None or not self._local.fit(particles.position):
                self._local = LocalParticles(particles.position, self.neighborhood)
        if density is None and not self.model.density_is_given:
            density = particles.density
        return Context(self.decomposition, particles, self.model.flow, self._local, self.resolution, rows, self.dtype,
                       density, time)
