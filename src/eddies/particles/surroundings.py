"""What is known of particles by their places alone."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from eddies.particles.flow_units import FlowUnits
from eddies.particles.neighborhood import LocalParticles, Neighborhood

if TYPE_CHECKING:
    from eddies.particles.kriging import Kriging


class Surroundings:
    """What the places of particles tell, whatever their velocities: evaluations at the same places share it.

    Parameters
    ----------
    position : (n, 3) of the owned particles. neighborhood : halo and neighbour list that fit them.
    flow : units of the model. dtype : of the pair arithmetic.
    """

    def __init__(self, position: Tensor, neighborhood: Neighborhood, flow: FlowUnits, dtype: torch.dtype) -> None:
        self.position, self.neighborhood, self.flow, self.dtype = position, neighborhood, flow, dtype
        self._state = self._state_with(position)

    def fit(self, position: Tensor) -> bool:
        """Whether they are those of these very positions, as they are, with the present halo and list, and with a
        gradient if one is being recorded. All ranks give either the positions of before or others."""
        return self.position is position and self._state == self._state_with(position)

    def _state_with(self, position: Tensor) -> tuple[int, int, bool]:
        return position._version, self.neighborhood.builds, torch.is_grad_enabled() and position.requires_grad

    @cached_property
    def local(self) -> LocalParticles:
        """The particles that this rank sees, ghosts included, without columns; collective."""
        return self.neighborhood.local(self.position)

    @cached_property
    def kriging(self) -> Kriging:
        """What neighbours tell of smooth fields at all owned particles; collective."""
        return self.solve_kriging()

    def solve_kriging(self) -> Kriging:
        """The same, made anew."""
        from eddies.particles.kriging import Kriging
        local = self.local
        pairs = local.neighbors.pairs(local.position[: len(self.position)].detach(), local.position.detach(),
                                      dtype=self.dtype)
        return Kriging(pairs, len(local.position), self.flow.cutoff, self.flow.scales.filter_width,
                       self.neighborhood.column)
