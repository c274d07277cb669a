"""Forces from the resolved velocity: pressure, viscosity, hidden stress, damping, relaxation and forcing."""

import torch
from torch import nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Coefficient, Term
from eddies.scene import terms as declared
from eddies.spectral.mode_operators import rising

# Initial values of D/(k_c u_c) at the six wavenumbers of Damping. They are proportional to k^2, like a small viscosity.
RATES = 0.1 * (torch.arange(1, 7, dtype=torch.float64) / 6) ** 2


class Pressure(Term):
    """The force -grad p with  laplacian p = -d_i d_j (u_i u_j)  for the resolved velocity u.

    p is the pressure divided by the mean density rho_0, and c the speed of sound. The density is rho_0 (1 + p / c^2):
    there is no density equation and no sound.
    """

    Settings = declared.Pressure
    linear = True

    def forward(self, context: Context) -> Rates:
        grid = context.resolved.grid
        pressure = grid.pressure_of(context.resolved.products)
        return Rates(force_modes=-grid.gradient(pressure), pressure_modes=pressure)


class Viscosity(Term):
    """The viscous force nu laplacian u, with the resolved velocity u and the viscosity nu of the flow."""

    Settings = declared.Viscosity
    linear = True

    def forward(self, context: Context) -> Rates:
        grid, velocity = context.resolved.grid, context.resolved.velocity
        return Rates(force_modes=-context.flow.scales.viscosity * grid.wavenumber_squared * velocity)


class Stress(Term):
    """The force -P[div tau] of the stress tau that the filter hides, with P the projection on solenoidal fields:

        tau = G(u* u*) - u u,          u* = u / G                                     form "deconvolution"
        tau = (d^2/12) grad u grad u^T                                                form "gradient"

    u is the resolved velocity, G the transfer function of the filter and d its width. The first form is exact except
    for unresolved modes (Stolz and Adams 1999). The second is the leading term of the first in powers of d (Leonard
    1975; Clark et al. 1979). The pressure of the stress contributes to the density. There is no learned parameter.
    """

    Settings = declared.Stress
    settings: declared.Stress
    linear = True

    def forward(self, context: Context) -> Rates:
        flow = context.resolved
        if self.settings.form == "deconvolution":
            stress = flow.filter_transfer * flow.grid.squares(flow.unfiltered) - flow.products
        else:
            slopes = flow.grid.slopes(flow.velocity)
            stress = flow.filter_width**2 / 12 * flow.grid.within(flow.grid.products(slopes, slopes))
        return flow.grid.hidden_stress(stress)


class Damping(Term):
    """The damping -D(k) u of the modes of the resolved velocity u, a spectral eddy viscosity (Kraichnan 1976).

    D is k_c u_c times six learned values at wavenumbers equally spaced up to the highest resolved one, k_c. D is linear
    between these wavenumbers, with D(0) = 0. u_c is the present rms of a velocity component of the smallest resolved
    scales, the modes of the unfiltered velocity above k_c/2. The energy transfer to unresolved scales depends on them.
    """

    Settings = declared.Damping
    linear = True

    def __init__(self, settings: declared.Damping, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.rates = nn.Parameter(RATES.clone())

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        return [Coefficient.of("D/(k_c u_c)", self.rates, "damping rates at k/k_c = 1/6, 2/6, ..., 1; u_c is the rms "
                               "of the smallest resolved scales")]

    def forward(self, context: Context) -> Rates:
        flow = context.resolved
        rates = rising(flow.grid.shell, flow.grid.resolved, self.rates.double().cpu()).to(flow.grid.dtype)
        return Rates(force_modes=-flow.grid.highest * flow.smallest_rms * rates * flow.velocity)


class Relaxation(Term):
    """The relaxation -C (v - u) of each particle's velocity v to the resolved velocity u.

    The mean of v - u over the particles is zero, because the least squares find u. C is a learned factor times
    2 u_rms/d, where u_rms is the present rms of a component of u about its mean.
    """

    Settings = declared.Relaxation
    linear = True

    def __init__(self, settings: declared.Relaxation, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.factor = nn.Parameter(torch.ones((), dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        return [Coefficient.of("C d/(2 u_rms)", self.factor, "relaxation rate of a velocity to the resolved one")]

    def forward(self, context: Context) -> Rates:
        flow = context.resolved
        missing = flow.missing()
        rate = (2 * flow.rms / flow.filter_width).to(missing) * self.factor.to(missing)
        return Rates(acceleration=-rate * missing)


class Forcing(Term):
    """The force A u(k) on the modes 0 < |k| < k_f of the resolved velocity u: linear forcing (Lundgren 2003).

    The velocity u* = u / G before the filter has the force A u* in the truth (`flow/forcing.py`), and receives the
    power P = `injection_rate`. So A = P / sum |u*(k)|^2, which is computed at each evaluation. The sum is over the
    forced modes. The filtered velocity receives a smaller power, A sum |u(k)|^2.
    """

    Settings = declared.Forcing
    settings: declared.Forcing
    linear = True

    def forward(self, context: Context) -> Rates:
        """Return the modes of the force. Raises TermError if the forced modes have no energy."""
        flow, below = context.resolved, self.settings.wavenumber
        square = flow.grid.mean_square(flow.unfiltered, 0, below)
        if square == 0 and self.settings.injection_rate > 0:
            raise declared.TermError("injection: the particles have no energy at the forced wavenumbers; remove "
                                     "the forcing, or raise its wavenumber until they have energy there")
        amplitude = self.settings.injection_rate / square if square > 0 else 0.0
        shell = flow.grid.shell
        return Rates(force_modes=amplitude * torch.where((shell > 0) & (shell < below), flow.velocity, 0))
