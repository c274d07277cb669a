"""A rate of density with the structure of the continuity equation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.kernels.pairs import Summand
from eddies.particles import moments
from eddies.particles.compiled_pairs import CompiledSum
from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.scaled_pairs import ScaledPairs
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import PairTerm

# The first a and b, of a trial on `hit`: with more divergence the scatter of the particles makes noise in the density
# (a = 0.07: five times the true rms), with less relaxation it grows until the rollout is lost.
FACTORS = 0.01, 0.4


class DensityTransport(PairTerm):
    """d rho_i/dt = -a rho_0 div v + b (c/h) (mean_j rho_j - rho_i)

    with the divergence from moment-corrected differences, the mean weighted by w, and a, b learned. Between scattered
    particles the divergence is mostly scatter, and a regression on the rates of single moments makes both factors
    vanish, without which the density does not last: they show through several steps alone.
    """

    Settings = declared.DensityTransport
    parity = torch.tensor([1.0] * 6 + [-1.0])
    mutual, needs_moments = True, True

    def __init__(self, settings: declared.DensityTransport, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.factors = nn.Parameter(torch.tensor(FACTORS, dtype=torch.float64))

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """The entries of w (x v^T + v x^T)/2, and w (rho'_j - rho'_i): (7, m)."""
        own, other = pairs.densities
        return torch.stack([*moments.symmetric_products(pairs.weight * pairs.x, pairs.v), pairs.weight * (other - own)])

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        return CompiledSum(Summand("density-transport", 7), self.factors.new_zeros(0), (context.density_fluctuation,))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The rate of density."""
        scales, around = context.flow.scales, context.moments
        divergence = moments.contract_symmetric(around.inverse, sums[:6])
        contrast = (sums[6:] / around.weight)[0]
        compression, relaxation = self.factors
        rate = (-compression * scales.density_mean * scales.velocity / scales.filter_width * divergence
                + relaxation * scales.sound_speed / context.flow.cutoff * scales.density * contrast)
        return Rates(density_rate=rate.to(context.particles.velocity.dtype))
