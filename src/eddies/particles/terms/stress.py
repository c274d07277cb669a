"""The stress that the filter hides."""

from __future__ import annotations

from torch import Tensor

from eddies.particles.context import Context
from eddies.particles.rates import Rates
from eddies.particles.resolved_flow import ResolvedFlow
from eddies.particles.terms.term import Term
from eddies.scene import terms as declared


class Stress(Term):
    """-grad p_tau - div tau = -P[div tau],  P the projection on solenoidal fields, of the stress

        tau = G(u* u*) - u u,          u* = u / G                                     form "deconvolution"
        tau = (d^2/12) grad u grad u^T                                                form "gradient"

    of the resolved velocity u, G the transfer of the filter of width d. The first is exact but for what is not resolved
    (Stolz and Adams 1999), the second the leading term of its expansion in d (Leonard 1975; Clark et al. 1979). Nothing
    is learned. The pressure p_tau of the stress belongs to the density too.
    """

    Settings = declared.Stress
    settings: declared.Stress
    linear = True

    def forward(self, context: Context) -> Rates:
        """Modes of the force and of p_tau."""
        flow = context.resolved
        stress = _deconvolved(flow) if self.settings.form == "deconvolution" else _gradient(flow)
        return flow.grid.hidden_stress(stress)


def _deconvolved(flow: ResolvedFlow) -> Tensor:
    """Modes (6, kz, ky, kx) of G(u* u*) - u u."""
    return flow.filter_transfer * flow.grid.squares(flow.unfiltered) - flow.products


def _gradient(flow: ResolvedFlow) -> Tensor:
    """Modes (6, kz, ky, kx) of (d^2/12) d_k u_i d_k u_j."""
    slopes = flow.grid.slopes(flow.velocity)
    return flow.filter_width**2 / 12 * flow.grid.within(flow.grid.products(slopes, slopes))
