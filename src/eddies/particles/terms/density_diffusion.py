"""Nonlinear diffusion of the density between the particles of a pair: the part of Pi in the density equation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.eddy_viscosity import SOFTENING
from eddies.particles.terms.pair_basis import density_rate, told, window
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared


class DensityDiffusion(PairTerm):
    """d rho_i/dt = -r_rms s sum_j w (|b_1| + |b_2| |q|) q with q = (rho'_i - rho'_j) / (|x|^2 + 0.1), in the units of
    `ScaledPairs`, as in the public code of the paper.

    r_rms is the rms of the density rate; w and s are window and scaling as in PairNetwork. What one particle of a pair
    gets the other loses. Both coefficients are learned.
    """

    Settings = declared.DensityDiffusion
    settings: declared.DensityDiffusion
    parity, mutual = -torch.ones(1), True

    def __init__(self, settings: declared.DensityDiffusion, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.coefficients = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """|b_1| and |b_2|; their values are those of a rate of density by q in physical units."""
        scales, (linear, quadratic) = self.flow.scales, self.coefficients.detach().abs()
        rate = scales.required("density_rate")
        per_difference = scales.filter_width**2 / scales.required("density")
        return [Coefficient.of("|b_1|", linear, "diffusion of the density: its rate by the difference q of a pair",
                               "L^2/T", rate * per_difference),
                Coefficient.of("|b_2|", quadratic, "nonlinear diffusion of the density: its rate by |q| q",
                               "L^7/(M T)", rate * per_difference**2)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """-w (|b_1| + |b_2| |q|) q, (1, m)."""
        own, other = pairs.densities
        q = (own - other) / (pairs.distance * pairs.distance + SOFTENING)
        linear, quadratic = self.coefficients.abs()
        return -(window(pairs, self.settings) * (linear + quadratic * q.abs()) * q)[None]

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        return CompiledSum("density-diffusion", (SOFTENING, told(self.settings)[1]), self.coefficients.abs(),
                           (context.density_fluctuation,), reads_velocity=False)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The rate of density."""
        return density_rate(sums, self.settings, context)
