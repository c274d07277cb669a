"""The filtered equations of motion by what neighbours tell: local, without a grid."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Coefficient, Term
from eddies.scene import terms as declared

# Two sweeps and more reduce what has eigenvalues from this over the square of their number to 1 alike, to an eighth.
LEAST = 2.0


class FilteredEquations(Term):
    """dv/dt = -grad p - div tau + nu laplacian u - C_r (2 u'/d) (v - u),   tau = f (d^2/12) grad u grad u^T

    with derivatives of the velocity u and of p by kriging among the neighbours (eddies.particles.kriging). v - u is
    what they alone do not tell of a particle's velocity; u' the rms of a component as it is now; f is learned, near 1,
    the value of the gradient model (Leonard 1975; Clark et al. 1979), whose force is -f (d^2/12) d_j d_k u_i d_k u_j.

    p/rho_0 is that of the particles' own density, c^2 (rho/rho_0 - 1), after some `sweeps` of Chebyshev's iteration by

        (laplacian p + s)_i / sum_j |w_ij|,   s = d_i u_j d_j u_i + div div tau - C_d (2 u'/d) div u,

    w_ij the weights of the Laplacian there, and the density follows it,

        d rho/dt = C_p (2 u'/d) (rho_0/c^2) (p - p before).

    So what is far away is told from neighbour to neighbour, sweep by sweep and not by sound, which need not be
    resolved. Forces, p and s are taken less their means over all particles.
    """

    Settings = declared.FilteredEquations
    settings: declared.FilteredEquations
    linear = True

    def __init__(self, settings: declared.FilteredEquations, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.stress = nn.Parameter(torch.ones((), dtype=torch.float64))
        self.stiffness = flow.scales.required("sound_speed") ** 2 / flow.scales.density_mean

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """f."""
        return [Coefficient.of("f", self.stress, "stress of the filter over that of the gradient model")]

    def forward(self, context: Context) -> Rates:
        """Acceleration and rate of density."""
        told, scales, settings = context.kriging, self.flow.scales, self.settings
        velocity = context.without_mean(context.particles.velocity)
        untold, first, second = told.derivatives(velocity)
        speed = mean_over_ranks(context.comm, velocity.square().mean(1, keepdim=True)).clamp_min(1e-300).sqrt()
        rate = (2 * speed / scales.filter_width).to(first)
        stress = self.stress.to(first) * (scales.filter_width**2 / 12)
        laplacian = second.diagonal(dim1=2, dim2=3).sum(2)
        force = (scales.viscosity * laplacian - stress * torch.einsum("nijk,njk->ni", second, first)
                 - settings.relaxation * rate * untold)
        source = (torch.einsum("nij,nji->n", first, first) + stress * torch.einsum("nikj,njki->n", second, second)
                  - settings.solenoidal * rate * first.diagonal(dim1=1, dim2=2).sum(1))
        before = (self.stiffness * (context.everywhere.own_density - scales.density_mean)).to(first)
        pressure = self._balanced(context, before, source)
        force = context.without_mean(force - told.gradient(pressure))
        change = settings.density * rate / self.stiffness * (pressure - before)
        return Rates(acceleration=force.to(velocity), density_rate=change.to(velocity))

    def _balanced(self, context: Context, pressure: Tensor, source: Tensor) -> Tensor:
        """The pressure after some sweeps."""
        told, source = context.kriging, context.without_mean(source[:, None])[:, 0]
        least, change, factor = min(LEAST / self.settings.sweeps**2, 1.0), torch.zeros_like(pressure), 0.0
        middle, half = (1 + least) / 2, (1 - least) / 2
        for sweep in range(self.settings.sweeps):
            residual = (told.laplacian(pressure) + source) / told.laplacian_bound
            factor = 1 / middle if sweep == 0 else 1 / (middle - half**2 * factor / (2 if sweep == 1 else 4))
            change = factor * residual + (factor * middle - 1) * change
            pressure = pressure + change
        return context.without_mean(pressure[:, None])[:, 0]  # which no sweep looks at: a constant has no Laplacian
