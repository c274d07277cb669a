"""Eddy viscosity and density diffusion between two particles: the terms Pi of Eq. 3."""

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_network import (
    SMALL, acceleration, along_separation, compiled_switches, density_rate, separation_direction, window,
)
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared

# This number is added to |x|^2 in the denominators of mu and q, to limit mu and q at small distances; in units of d^2.
SOFTENING = 0.1
# Forms of Pi, in the order of their numbers in the compiled library.
FORMS = "two-sided", "monaghan", "bounded"


class EddyViscosity(PairTerm):
    """Eddy viscosity between two particles, dv_i/dt = a_rms s sum_j w Pi b_1 with

        Pi = -|a_1| mu + |a_2| mu^2,   mu = x.v / (|x|^2 + 0.1),

    in the units of `ScaledPairs`. a_rms, the window w and the scaling s are as in PairNetwork; in the basis "corrected"
    M_i^-1 replaces s. b_1 is x, or x/|x| in the basis "unit". A positive Pi repels. In the form "two-sided" the part
    |a_2| mu^2 also repels receding pairs. In the form "bounded" tanh(x.v) replaces x.v, as in the public code of the
    paper, so the force of a fast pair has a limit. In the form "monaghan" only approaching pairs (mu < 0) have a force,
    as in SPH. The coefficients a_1 and a_2 are learned.
    """

    Settings = declared.EddyViscosity
    settings: declared.EddyViscosity
    parity, mutual = -torch.ones(3), True

    def __init__(self, settings: declared.EddyViscosity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.needs_moments = settings.basis == "corrected"
        self.coefficients = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        scales, (linear, quadratic) = self.flow.scales, self.coefficients.detach().abs()
        per_rate = scales.filter_width / scales.velocity
        return [Coefficient.of("|a_1|", linear, "friction of a pair: acceleration per approach rate mu", "L/T",
                               scales.acceleration * per_rate),
                Coefficient.of("|a_2|", quadratic, "repulsion of a pair: acceleration per mu^2", "L",
                               scales.acceleration * per_rate**2)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        form, approach = self.settings.form, pairs.approach
        mu = (torch.tanh(approach) if form == "bounded" else approach) / (pairs.distance**2 + SOFTENING)
        if form == "monaghan":
            mu = torch.clamp(mu, max=0)
        linear, quadratic = self.coefficients.abs()
        strength = window(pairs, self.settings) * mu * (quadratic * mu - linear)
        return strength * separation_direction(pairs, self.settings)

    def compiled(self, context: Context) -> CompiledSum:
        unit, weighted = compiled_switches(self.settings)
        length = SMALL if unit else 1.0  # b_1 = x / (unit |x| + length)
        return CompiledSum("eddy-viscosity", (FORMS.index(self.settings.form), SOFTENING, weighted, unit, length),
                           self.coefficients.abs())

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return Rates(acceleration(along_separation(sums, self.settings, context), context))


class DensityDiffusion(PairTerm):
    """Diffusion of the density between two particles, as in the public code of the paper:

        d rho_i/dt = -r_rms s sum_j w (|b_1| + |b_2| |q|) q,   q = (rho'_i - rho'_j) / (|x|^2 + 0.1),

    in the units of `ScaledPairs`. r_rms is the rms of the density rate. The window w and the scaling s are as in
    PairNetwork. One particle of a pair gains what the other loses. The coefficients b_1 and b_2 are learned.
    """

    Settings = declared.DensityDiffusion
    settings: declared.DensityDiffusion
    parity, mutual = -torch.ones(1), True

    def __init__(self, settings: declared.DensityDiffusion, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.coefficients = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        scales, (linear, quadratic) = self.flow.scales, self.coefficients.detach().abs()
        rate = scales.required("density_rate")
        per_difference = scales.filter_width**2 / scales.required("density")
        return [Coefficient.of("|b_1|", linear, "diffusion of the density: its rate per difference q of a pair",
                               "L^2/T", rate * per_difference),
                Coefficient.of("|b_2|", quadratic, "nonlinear diffusion of the density: its rate per |q| q",
                               "L^7/(M T)", rate * per_difference**2)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        own, other = pairs.densities
        q = (own - other) / (pairs.distance**2 + SOFTENING)
        linear, quadratic = self.coefficients.abs()
        return -(window(pairs, self.settings) * (linear + quadratic * q.abs()) * q)[None]

    def compiled(self, context: Context) -> CompiledSum:
        return CompiledSum("density-diffusion", (SOFTENING, compiled_switches(self.settings)[1]),
                           self.coefficients.abs(), (context.density_fluctuation,), reads_velocity=False)

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return density_rate(sums, self.settings, context)
