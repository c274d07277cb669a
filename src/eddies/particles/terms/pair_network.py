"""Learned networks of pairs: the force and the density rate of Eqs. 3 and 4."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_basis import (
    acceleration, along_separation, along_velocity, build_network, compiled_network, density_rate, separation_direction,
    velocity_direction, window,
)
from eddies.particles.terms.term import PairTerm
from eddies.scene import terms as declared


class PairNetwork(PairTerm):
    """dv_i/dt = a_rms A_i with

        A_i = s (sum_j w NN_1 x + sum_j w NN_2 v)                            basis "paper"
        A_i = s (sum_j w NN_1 x/|x| + sum_j w NN_2 v/|v|)                    basis "unit"
        A_i = M_i^-1 sum_j w NN_1 x + sum_j w NN_2 v / sum_j w               basis "corrected"

    NN_1 and NN_2 are functions of the invariants of a pair (rho'_i, rho'_j, |x|, |v|, x.v) in the units of
    `ScaledPairs`. w is the window, s the scaling and M_i = sum_j w x x^T. With symmetry "antisymmetric" the first two
    invariants are rho'_i + rho'_j and (rho'_i - rho'_j)^2: the forces of a pair are opposite and conserve the total
    momentum. Without the densities the sums are opposite too. Opposite sums evaluate each pair once.
    """

    Settings = declared.PairNetwork
    settings: declared.PairNetwork
    parity = -torch.ones(6)

    def __init__(self, settings: declared.PairNetwork, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.network = build_network(settings, 2, flow.seed)
        self.mutual = settings.symmetry == "antisymmetric" or "density" not in settings.inputs
        self.needs_moments = settings.basis == "corrected"
        self.width = max(settings.hidden)

    def features(self, pairs: ScaledPairs) -> Tensor:
        """Inputs of the network, (features, m)."""
        return pairs.invariants(self.settings.inputs, self.mutual)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """w NN_1 b_1 and w NN_2 b_2, (6, m)."""
        along_x, along_v = window(pairs, self.settings) * self.network(self.features(pairs))
        return torch.cat([along_x * separation_direction(pairs, self.settings),
                          along_v * velocity_direction(pairs, self.settings)])

    def compiled(self, context: Context) -> CompiledSum | None:
        return compiled_network(self.network, self.settings, 2, self.mutual, context)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return Rates(acceleration(along_separation(sums[:3], self.settings, context)
                                  + along_velocity(sums[3:], self.settings, context), context))


class DensityFlux(PairTerm):
    """d rho_i/dt = r_rms s sum_j w NN_rho, or w NN_rho sign(rho_i - rho_j), a function of the invariants of a pair.

    r_rms is the rms of the density rate and NN_rho a network of its own; w, s and the invariants are as in PairNetwork.
    The paper does not state what replaces b_k for the density; the sign is that of the public code.
    """

    Settings = declared.DensityFlux
    settings: declared.DensityFlux

    def __init__(self, settings: declared.DensityFlux, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        # Initial weights other than those of the force.
        self.network = build_network(settings, 1, flow.seed + 1)
        self.mutual, self.width = "density" not in settings.inputs, max(settings.hidden)
        self.parity = torch.full((1,), -1.0 if settings.sign else 1.0)

    def features(self, pairs: ScaledPairs) -> Tensor:
        """Inputs of the network, (features, m)."""
        return pairs.invariants(self.settings.inputs, symmetric=False)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """w NN_rho, times the sign, (1, m)."""
        flux = window(pairs, self.settings) * self.network(self.features(pairs))
        if not self.settings.sign:
            return flux
        own, other = pairs.densities
        return flux * torch.sign(own - other)

    def compiled(self, context: Context) -> CompiledSum | None:
        return compiled_network(self.network, self.settings, 1, False, context, self.settings.sign)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return density_rate(sums, self.settings, context)
