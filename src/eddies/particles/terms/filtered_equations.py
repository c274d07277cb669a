"""The filtered equations of motion by kriging among neighbours, without a grid."""

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Coefficient, Term
from eddies.scene import terms as declared

# The sweeps of the pressure iterate with the operator -laplacian / sum_j |w_ij|. Two or more sweeps reduce an error
# to an eighth or less if it belongs to an eigenvalue between LEAST / sweeps^2 and 1.
LEAST = 2.0


class FilteredEquations(Term):
    """The filtered equations of motion, with derivatives by kriging among neighbours:

        dv/dt = -grad p - div tau + nu laplacian u - C_r (2 u'/d) (v - u),   tau = f (d^2/12) grad u grad u^T

    The derivatives of the velocity u and of p are kriging estimates (eddies.particles.kriging). v - u is the difference
    between a particle's velocity and the neighbours' estimate. u' is the present rms of a component of v, d the filter
    width and nu the viscosity. f is learned. It is near 1, the value of the gradient model (Leonard 1975; Clark et al.
    1979). The force -div tau is -f (d^2/12) d_j d_k u_i d_k u_j. C_r, C_d and C_p are the settings `relaxation`,
    `solenoidal` and `density`.

    p, the pressure divided by rho_0, starts from c^2 (rho/rho_0 - 1) with the particles' own density. `sweeps` steps of
    Chebyshev's iteration then reduce the residual

        (laplacian p + s)_i / sum_j |w_ij|,   s = d_i u_j d_j u_i + div div tau - C_d (2 u'/d) div u,

    with the weights w_ij of the Laplacian. The density follows the pressure,

        d rho/dt = C_p (2 u'/d) (rho_0/c^2) (p - p before the sweeps).

    So pressure spreads from neighbour to neighbour, sweep by sweep, and no sound has to be resolved. p and s are taken
    relative to their means over all particles: a constant in p has no force.
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
        return [Coefficient.of("f", self.stress, "stress of the filter relative to the gradient model")]

    def forward(self, context: Context) -> Rates:
        kriging, scales, settings = context.kriging, self.flow.scales, self.settings
        velocity = context.without_mean(context.particles.velocity)
        residual, first, second = kriging.derivatives(velocity)
        square = mean_over_ranks(context.comm, velocity.square().mean(1, keepdim=True))
        speed = square.clamp_min(torch.finfo(square.dtype).tiny).sqrt()
        rate = (2 * speed / scales.filter_width).to(first)
        stress = self.stress.to(first) * (scales.filter_width**2 / 12)
        laplacian = second.diagonal(dim1=2, dim2=3).sum(2)
        force = (scales.viscosity * laplacian - stress * torch.einsum("nijk,njk->ni", second, first)
                 - settings.relaxation * rate * residual)
        source = (torch.einsum("nij,nji->n", first, first) + stress * torch.einsum("nikj,njki->n", second, second)
                  - settings.solenoidal * rate * first.diagonal(dim1=1, dim2=2).sum(1))
        before = (self.stiffness * (context.everywhere.own_density - scales.density_mean)).to(first)
        pressure = self._balanced(context, before, source)
        force = force - kriging.gradient(pressure)
        change = settings.density * rate / self.stiffness * (pressure - before)
        return Rates(acceleration=force.to(velocity), density_rate=change.to(velocity))

    def _balanced(self, context: Context, pressure: Tensor, source: Tensor) -> Tensor:
        """Return the pressure (n,) after the sweeps of Chebyshev's iteration. `source` is s."""
        kriging, source = context.kriging, context.without_mean(source[:, None])[:, 0]
        bound = kriging.laplacian_bound.to(source)
        least, change, factor = min(LEAST / self.settings.sweeps**2, 1.0), torch.zeros_like(pressure), 0.0
        middle, half = (1 + least) / 2, (1 - least) / 2
        for sweep in range(self.settings.sweeps):
            residual = (kriging.laplacian(pressure) + source) / bound
            factor = 1 / middle if sweep == 0 else 1 / (middle - half**2 * factor / (2 if sweep == 1 else 4))
            change = factor * residual + (factor * middle - 1) * change
            pressure = pressure + change
        return context.without_mean(pressure[:, None])[:, 0]  # sweeps leave a constant, as its Laplacian is 0
