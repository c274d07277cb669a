"""The paper's rate of density: a learned flux between the particles of a pair."""

from __future__ import annotations

from torch import Tensor

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_basis import build_network, compiled_network
from eddies.particles.terms.term import PairTerm
from eddies.scene import terms as declared


class DensityFlux(PairTerm):
    """d rho_i/dt = r_rms/n sum_j w NN_rho of the invariants of a pair (see PairNetwork), r_rms the rms of the density
    rate and NN_rho a network of its own."""

    Settings = declared.DensityFlux
    settings: declared.DensityFlux

    def __init__(self, settings: declared.DensityFlux, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        # Another network than that of the force, so other initial weights.
        self.network = build_network(settings, 1, flow.seed + 1)
        self.mutual, self.width = "density" not in settings.inputs, max(settings.hidden)

    def features(self, pairs: ScaledPairs) -> Tensor:
        """What the network is given, (features, m)."""
        return pairs.invariants(self.settings.inputs, symmetric=False)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """w NN_rho, (1, m)."""
        return pairs.weight * self.network(self.features(pairs))

    def compiled(self, context: Context) -> CompiledSum | None:
        """The same for the compiled library."""
        return compiled_network(self.network, self.settings.inputs, 1, False, context)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The rate of density."""
        rate = context.flow.scales.required("density_rate") / context.flow.neighbors * sums[0]
        return Rates(density_rate=rate.to(context.particles.velocity.dtype))
