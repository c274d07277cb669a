"""The stress that the filter hides, by the gradient model."""

from __future__ import annotations

import torch
from torch import nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import Term


class Stress(Term):
    """-grad p_tau - div tau = -P[div tau] with  tau = A (d^2/12) grad u grad u^T,  P the projection on solenoidal
    fields.

    The leading term of what a filter of width d hides (Leonard 1975; Clark et al. 1979), for which A = 1; A is learned.
    The pressure p_tau of the stress belongs to the density too.
    """

    Settings = declared.Stress
    linear = True

    def __init__(self, settings: declared.Stress, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.amplitude = nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context: Context) -> Rates:
        """Modes of the force and of p_tau."""
        grid = context.resolved.grid
        slopes = grid.slopes(context.resolved.velocity)
        factor = self.amplitude.double().cpu() * context.flow.scales.length**2 / 12
        return grid.hidden_stress(factor * grid.products(slopes, slopes))
