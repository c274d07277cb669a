"""The density of smoothed particle hydrodynamics."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from eddies.kernels.pairs import Summand
from eddies.particles.compiled_pairs import CompiledSum
from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.scaled_pairs import ScaledPairs
from eddies.particles.smoothing_kernels import CubicSpline, SmoothingKernel, WendlandC2
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import PairTerm

KERNELS: dict[str, Callable[[float], SmoothingKernel]] = {"cubic-spline": CubicSpline, "wendland": WendlandC2}


def particle_mass(flow: FlowUnits) -> float:
    """Mass of a particle: that of all fluid over the number of particles."""
    return flow.scales.density_mean * flow.scales.spacing**3


def over_distance(slope: Tensor, distance: Tensor) -> Tensor:
    """W'/r: the slope vanishes at r = 0, so that the quotient is 0 for coincident particles."""
    return slope / distance.clamp(min=torch.finfo(distance.dtype).tiny)


class SummationDensity(PairTerm):
    """rho_i = sum_j m W(x_i - x_j), the particle itself counted once; W with the radius of interaction as its
    support."""

    Settings = declared.SummationDensity
    settings: declared.SummationDensity
    parity, mutual = torch.ones(1), True

    def __init__(self, settings: declared.SummationDensity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.kernel, self.mass = KERNELS[settings.kernel](flow.cutoff), particle_mass(flow)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """W, (1, m)."""
        return self.kernel.value(pairs.pairs.distance).unsqueeze(0)

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        support = self.kernel.support
        told = Summand("summation-density", 1, (self.settings.kernel == "wendland",),
                       (support / context.flow.scales.filter_width, support**-3))
        return CompiledSum(told, torch.empty(0), reads_velocity=False)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The density's deviation from the mean."""
        itself = self.kernel.value(sums.new_zeros(()))
        density = (self.mass * (sums[0] + itself)).to(context.particles.velocity.dtype)
        return Rates(density=density - context.flow.scales.density_mean)
