"""Molecular viscosity of the resolved velocity."""

from __future__ import annotations

from eddies.particles.context import Context
from eddies.particles.rates import Rates
from eddies.particles.terms import settings as declared
from eddies.particles.terms.term import Term


class Viscosity(Term):
    """nu laplacian u of the resolved velocity u, with the viscosity nu of the flow."""

    Settings = declared.Viscosity
    linear = True

    def forward(self, context: Context) -> Rates:
        """Modes of the force."""
        flow = context.resolved
        return Rates(force_modes=-self.flow.scales.viscosity * flow.grid.wavenumber_squared * flow.velocity)
