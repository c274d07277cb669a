"""The density equation of smoothed particle hydrodynamics."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import CubicSpline, over_distance
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared


class Continuity(PairTerm):
    """d rho_i/dt = rho_i sum_j (m/rho_j) (v_i - v_j).grad W  (Monaghan 2005), and with `diffusion` that of delta-SPH
    (Molteni & Colagrossi 2009),

        + 2 delta h c sum_j (m/rho_j) (rho_j - rho_i) (-W'/r)

    with the radius of interaction as the support of W, h half of it, and the sound speed c of the flow. delta is a
    parameter, of which |delta| counts: a negative one would sharpen what it should smooth. Nothing else is.
    """

    Settings = declared.Continuity
    settings: declared.Continuity
    mutual = True

    def __init__(self, settings: declared.Continuity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.kernel, self.mass = CubicSpline(flow.cutoff), flow.particle_mass
        self.diffusivity = flow.cutoff * flow.scales.required("sound_speed")  # 2 h c
        self.delta = nn.Parameter(torch.tensor(settings.diffusion, dtype=torch.float64)) if settings.diffusion else None
        self.parity = torch.tensor([1.0] if self.delta is None else [1.0, -1.0])

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """|delta|, where there is one; its value is the diffusivity 2 |delta| h c."""
        return [] if self.delta is None else [Coefficient.of(
            "|delta|", self.delta.abs(), "diffusivity 2 |delta| h c of the density", "L^2/T", self.diffusivity)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """m v.grad W and, with diffusion, m (rho_j - rho_i) W'/r, both over rho_i rho_j: (components, m)."""
        listed = pairs.pairs
        density = pairs.column("density").to(listed.distance)
        own, other = listed.at_receivers(density), listed.at_senders(density)
        slope = self.mass * over_distance(self.kernel.derivative(listed.distance), listed.distance) / (own * other)
        found = [slope * (listed.displacement.T * pairs.velocity_difference).sum(0)]
        return torch.stack(found if self.delta is None else [*found, slope * (other - own)])

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        scales, support = context.flow.scales, self.kernel.support
        width, unit = scales.filter_width, self.mass / support**5
        return CompiledSum("continuity", (support / width, unit * width * scales.velocity, unit),
                           scalars=(context.column("density"),))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The rate of density."""
        density = context.own_density.to(sums)
        rate = density**2 * sums[0]
        if self.delta is not None:
            rate = rate - self.delta.abs() * self.diffusivity * density * sums[1]
        return Rates(density_rate=rate.to(context.particles.velocity.dtype))
