"""Molecular viscosity of the resolved velocity."""

from __future__ import annotations

from eddies.particles.context import Context
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Term
from eddies.scene import terms as declared


class Viscosity(Term):
    """nu laplacian u of the resolved velocity u, with the viscosity nu of the flow."""

    Settings = declared.Viscosity
    linear = True

    def forward(self, context: Context) -> Rates:
        """Modes of the force."""
        grid, velocity = context.resolved.grid, context.resolved.velocity
        return Rates(force_modes=-context.flow.scales.viscosity * grid.wavenumber_squared * velocity)
