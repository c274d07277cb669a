"""Spectral eddy damping of the resolved velocity."""

from __future__ import annotations

import math

import torch
from torch import nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Coefficient, Term
from eddies.scene import terms as declared
from eddies.spectral.mode_operators import rising

# The rates D to begin with: as those of a small viscosity, growing as k^2.
RATES = 0.1 * (torch.arange(1, 7, dtype=torch.float64) / 6) ** 2


class Damping(Term):
    """-D(k) u of the modes of the resolved velocity u, a spectral eddy viscosity (Kraichnan 1976).

    D is k_c u_c times six learned values at wavenumbers equally spaced up to the highest that is resolved, k_c, linear
    between them and from D(0) = 0. u_c is the rms of a component of the smallest resolved scales as they are now, the
    modes of the unfiltered velocity above k_c/2: what the scales beyond take depends on how much of them there is.
    """

    Settings = declared.Damping
    linear = True

    def __init__(self, settings: declared.Damping, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.rates = nn.Parameter(RATES.clone())

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """D at the six wavenumbers, in units that change with the flow."""
        return [Coefficient.of("D/(k_c u_c)", self.rates, "rates of damping at k/k_c = 1/6, 2/6, ..., 1, u_c the rms "
                               "of the smallest resolved scales")]

    def forward(self, context: Context) -> Rates:
        """Modes of the force."""
        flow = context.resolved
        highest = 2 * math.pi / context.decomposition.length * flow.grid.resolved
        rates = rising(flow.grid.shell, flow.grid.resolved, self.rates.double().cpu()).to(flow.grid.dtype)
        return Rates(force_modes=-highest * flow.smallest_rms * rates * flow.velocity)
