"""Relaxation of the particles' velocity to what the grid resolves of it."""

from __future__ import annotations

import torch
from torch import nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import Term


class Relaxation(Term):
    """-C (v - u) of what the resolved velocity u misses of a particle's v, less its mean over the particles, so that it
    keeps their momentum. C is 2 v_rms/d times a learned factor."""

    Settings = declared.Relaxation
    linear = True

    def __init__(self, settings: declared.Relaxation, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.factor = nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context: Context) -> Rates:
        """The acceleration."""
        scales = context.flow.scales
        missing = context.resolved.missing()
        rate = 2 * scales.velocity / scales.length * self.factor.to(missing)
        return Rates(acceleration=-rate * context.without_mean(missing))
