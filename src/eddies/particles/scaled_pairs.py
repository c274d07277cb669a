"""Pairs of particles in the units of a model, as the terms of a sum over neighbours see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property

import torch
from torch import Tensor

from eddies.particles import moments
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import Pairs
from eddies.particles.periodic_box import safe_norm


class ScaledPairs:
    """Some pairs (i, j) with what they carry, computed where it is asked for first.

    Lengths are in units of the filter width d, velocities of v_rms, density fluctuations of rho_rms:
    x = (x_i - x_j)/d, v = (v_i - v_j)/v_rms, rho' = (rho - rho_0)/rho_rms.

    Parameters
    ----------
    pairs : as listed, in the units of the simulation.
    column : gives a column (s, ...), "velocity" or "density", of the particles that the pairs number, ghosts included.
    flow : the units, and the radius of interaction.
    """

    def __init__(self, pairs: Pairs, column: Callable[[str], Tensor], flow: FlowUnits) -> None:
        self.pairs, self.column, self.flow = pairs, column, flow

    @cached_property
    def x(self) -> Tensor:
        """(3, m)."""
        return self.pairs.displacement.T / self.flow.scales.filter_width

    @cached_property
    def v(self) -> Tensor:
        """(3, m)."""
        return self.velocity_difference / self.flow.scales.velocity

    @cached_property
    def velocity_difference(self) -> Tensor:
        """v_i - v_j (3, m) in the units of the simulation."""
        velocity = self.column("velocity")
        return (self.pairs.at_receivers(velocity) - self.pairs.at_senders(velocity)).T.to(self.pairs.displacement)

    @cached_property
    def densities(self) -> tuple[Tensor, Tensor]:
        """rho'_i and rho'_j (m,)."""
        scales, density = self.flow.scales, self.column("density")
        own, other = (((column - scales.density_mean) / scales.density).to(self.pairs.displacement)
                      for column in (self.pairs.at_receivers(density), self.pairs.at_senders(density)))
        return own, other

    @cached_property
    def distance(self) -> Tensor:
        """|x| (m,)."""
        return self.pairs.distance / self.flow.scales.filter_width

    @cached_property
    def approach(self) -> Tensor:
        """x.v (m,), negative where particles approach each other."""
        return (self.x * self.v).sum(0)

    @cached_property
    def weight(self) -> Tensor:
        """w = (1 - q^2)^2 (m,), q the distance over the radius of interaction: rates are smooth where a neighbour
        enters or leaves."""
        return moments.weight(self.pairs.distance, self.flow.cutoff)

    def invariants(self, names: Sequence[str], symmetric: bool) -> Tensor:
        """What a network is told of the pairs, (features, m), in the order of INPUTS of the settings.

        "density" makes two features: rho'_i and rho'_j, or, `symmetric`, rho'_i + rho'_j and (rho'_i - rho'_j)^2, which
        are the same for (i, j) and (j, i) as all others are.
        """
        features: list[Tensor] = []
        if "density" in names:
            own, other = self.densities
            features += [own + other, (own - other).square()] if symmetric else [own, other]
        if "distance" in names:
            features.append(self.distance)
        if "speed" in names:
            features.append(safe_norm(self.v, dim=0))
        if "approach" in names:
            features.append(self.approach)
        return torch.stack(features)
