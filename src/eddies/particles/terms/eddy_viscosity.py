"""The eddy viscosity between two particles: the term Pi of Eq. 3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.terms.pair_basis import (
    SMALL, acceleration, along_separation, separation_direction, told, window,
)
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared

# Softens the approach speed at small distances, in squared units of the reference length.
SOFTENING = 0.1
# In the order that the compiled library numbers them.
FORMS = "two-sided", "monaghan", "bounded"


class EddyViscosity(PairTerm):
    """a_rms times the sum of w Pi b_1, weighted and scaled as that of the pair network, with

        Pi = -|a_1| mu + |a_2| mu^2,   mu = x.v / (|x|^2 + 0.1),

    in the units of `ScaledPairs`. A positive Pi pushes apart. The form "two-sided" pushes receding pairs apart as well,
    by its part mu^2. "bounded" has tanh(x.v) in place of x.v, as in the public code of the paper: the force of a fast
    pair has a limit. "monaghan" acts on approaching pairs only (mu < 0), as in SPH. Both coefficients are learned.
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
        """|a_1| and |a_2|; their values are those of an acceleration by mu in physical units, with b_1 as it is."""
        scales, (linear, quadratic) = self.flow.scales, self.coefficients.detach().abs()
        per_rate = scales.filter_width / scales.velocity
        return [Coefficient.of("|a_1|", linear, "friction of a pair: acceleration by its rate of approach mu", "L/T",
                               scales.acceleration * per_rate),
                Coefficient.of("|a_2|", quadratic, "repulsion of a pair: acceleration by mu^2", "L",
                               scales.acceleration * per_rate**2)]

    def strength(self, distance: Tensor, approach: Tensor) -> Tensor:
        """Pi (m,) from |x| (m,) and x.v (m,)."""
        if self.settings.form == "bounded":
            approach = torch.tanh(approach)
        mu = approach / (distance * distance + SOFTENING)
        if self.settings.form == "monaghan":
            mu = torch.clamp(mu, max=0)
        linear, quadratic = self.coefficients.abs()
        return mu * (quadratic * mu - linear)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """w Pi b_1, (3, m)."""
        return (window(pairs, self.settings) * self.strength(pairs.distance, pairs.approach)
                ) * separation_direction(pairs, self.settings)

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        unit, weighted = told(self.settings)
        # b_1 = x / (unit |x| + length)
        length = SMALL if unit else 1.0
        return CompiledSum("eddy-viscosity", (FORMS.index(self.settings.form), SOFTENING, weighted, unit, length),
                           self.coefficients.abs())

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The acceleration."""
        return Rates(acceleration(along_separation(sums, self.settings, context), context))
