"""The network of the density in Eq. 3."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_basis import build_network, compiled_network, density_rate, window
from eddies.particles.terms.term import PairTerm
from eddies.scene import terms as declared


class DensityFlux(PairTerm):
    """d rho_i/dt = r_rms s sum_j w NN_rho, or w NN_rho sign(rho_i - rho_j), of the invariants of a pair.

    r_rms is the rms of the density rate, NN_rho a network of its own; w, s and the invariants as in PairNetwork. The
    paper's text does not say what the density has in place of b_k; the sign is that of the public code.
    """

    Settings = declared.DensityFlux
    settings: declared.DensityFlux

    def __init__(self, settings: declared.DensityFlux, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        # Another network than that of the force, so other initial weights.
        self.network = build_network(settings, 1, flow.seed + 1)
        self.mutual, self.width = "density" not in settings.inputs, max(settings.hidden)
        self.parity = torch.full((1,), -1.0 if settings.sign else 1.0)

    def features(self, pairs: ScaledPairs) -> Tensor:
        """What the network is given, (features, m)."""
        return pairs.invariants(self.settings.inputs, symmetric=False)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """w NN_rho, times the sign, (1, m)."""
        flux = window(pairs, self.settings) * self.network(self.features(pairs))
        if not self.settings.sign:
            return flux
        own, other = pairs.densities
        return flux * torch.sign(own - other)

    def compiled(self, context: Context) -> CompiledSum | None:
        """The same for the compiled library."""
        return compiled_network(self.network, self.settings, 1, False, context, self.settings.sign)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The rate of density."""
        return density_rate(sums, self.settings, context)
