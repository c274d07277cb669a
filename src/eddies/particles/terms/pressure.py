"""The pressure of the resolved velocity."""

from __future__ import annotations

from eddies.particles.context import Context
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Term
from eddies.scene import terms as declared


class Pressure(Term):
    """-grad p with  laplacian p = -d_i d_j (u_i u_j)  of the resolved velocity u, and the density rho_0 (1 + p / c^2)
    that belongs to p: no density equation, no sound."""

    Settings = declared.Pressure
    linear = True

    def forward(self, context: Context) -> Rates:
        """Modes of pressure and force."""
        grid = context.resolved.grid
        pressure = grid.pressure_of(context.resolved.products)
        return Rates(force_modes=-grid.gradient(pressure), pressure_modes=pressure)
