"""Relaxation of the particles' velocity to what the grid resolves of it."""

from __future__ import annotations

import torch
from torch import nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Coefficient, Term
from eddies.scene import terms as declared


class Relaxation(Term):
    """-C (v - u) of what the resolved velocity u misses of a particle's v, less its mean over the particles, so that it
    keeps their momentum. C is 2 u_rms/d times a learned factor, u_rms that of u as it is now."""

    Settings = declared.Relaxation
    linear = True

    def __init__(self, settings: declared.Relaxation, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.factor = nn.Parameter(torch.ones((), dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """C, in units that change with the flow."""
        return [Coefficient.of("C d/(2 u_rms)", self.factor, "rate at which a velocity relaxes to the resolved one")]

    def forward(self, context: Context) -> Rates:
        """The acceleration."""
        flow = context.resolved
        missing = context.without_mean(flow.missing())
        rate = (2 * flow.rms / flow.filter_width).to(missing) * self.factor.to(missing)
        return Rates(acceleration=-rate * missing)
