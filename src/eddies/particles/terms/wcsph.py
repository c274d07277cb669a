"""Weakly compressible smoothed particle hydrodynamics: forces from the particles' density."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import CubicSpline, over_distance
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared

# Softens the approach rate at small distances, in squared smoothing lengths (Monaghan 1992).
SOFTENING = 0.01


class WCSPH(PairTerm):
    """Pressure and artificial viscosity of WCSPH (Monaghan 1992),

        dv_i/dt = -sum_j m (P_i/rho_i^2 + P_j/rho_j^2 + Pi_ij) grad W(x_i - x_j)
        P = c^2 rho_0/gamma ((rho/rho_0)^gamma - 1)
        Pi_ij = (-alpha c mu + beta mu^2)/mean(rho_i, rho_j),   mu = h x.v/(r^2 + 0.01 h^2)

    Pi only for approaching pairs, x.v < 0. The smoothing length h is half the support of W, which is the radius of
    interaction. Forces of a pair are opposite and central, so momentum and angular momentum are kept. In three
    dimensions Pi acts like a viscosity of about alpha c h / 10. The sound speed of P in units of the flow's, alpha and
    beta are parameters, of which the size counts, so that pressure pushes and friction takes energy. That of Pi is the
    flow's: too large an alpha would else teach the pressure to vanish. gamma stays as it is set, as nothing tells it
    where the density hardly varies.

    Particles at random do not see a gradient by that sum: the differences (P_j - P_i)/(rho_i rho_j) in its place have
    half its error at single moments, but lose the balance of pressure and density, and energy grows until a rollout
    ends, unless particles are kept in place by a shift; then they are no better.
    """

    Settings = declared.WCSPH
    settings: declared.WCSPH
    # The forces of a pair are opposite, so each pair is evaluated once.
    parity, mutual = -torch.ones(3), True

    def __init__(self, settings: declared.WCSPH, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.kernel, self.mass = CubicSpline(flow.cutoff), flow.particle_mass
        self.density = flow.scales.density_mean
        self.sound_speed, self.alpha, self.beta = (nn.Parameter(torch.tensor(value, dtype=torch.float64))
                                                   for value in (1.0, settings.alpha, settings.beta))
        self.c = flow.scales.required("sound_speed")

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """|c|, |alpha| and |beta|."""
        return [Coefficient.of("|c|", self.sound_speed.abs(), "sound speed of the pressure; learned over that of the "
                               "flow", "L/T", self.c),
                Coefficient.of("|alpha|", self.alpha.abs(), "linear artificial viscosity: acts like alpha c h / 10"),
                Coefficient.of("|beta|", self.beta.abs(), "quadratic artificial viscosity")]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """What each pair (i, j) accelerates i by, (3, m)."""
        listed = pairs.pairs
        x = listed.displacement.T
        density = pairs.column("density").to(x.dtype)
        push = self.pressure(density) / density**2
        strength = listed.at_receivers(push) + listed.at_senders(push) + self._viscosity(pairs, density)
        return -self.mass * strength * over_distance(self.kernel.derivative(listed.distance), listed.distance) * x

    def compiled(self, context: Context) -> CompiledSum:
        """The same for the compiled library."""
        scales, density, support = context.flow.scales, context.column("density"), self.kernel.support
        width = scales.filter_width
        numbers = support / width, self.mass * width / support**5, SOFTENING * (support / (2 * width)) ** 2
        viscosity = torch.stack([scales.velocity * self.alpha.abs() * self.c, scales.velocity**2 * self.beta.abs()])
        return CompiledSum("wcsph", numbers, viscosity, (self.pressure(density) / density**2, density))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The acceleration."""
        return Rates(acceleration=sums.T.to(context.particles.velocity.dtype))

    def pressure(self, density: Tensor) -> Tensor:
        """P of densities of any shape."""
        c, gamma, rho_0 = self.c * self.sound_speed, self.settings.exponent, self.density
        return c**2 * rho_0 / gamma * ((density / rho_0) ** gamma - 1)

    def _viscosity(self, pairs: ScaledPairs, density: Tensor) -> Tensor:
        """Pi (m,) of the pairs."""
        listed, h = pairs.pairs, self.kernel.support / 2
        approach = (listed.displacement.T * pairs.velocity_difference).sum(0)
        mu = torch.clamp(h * approach / (listed.distance**2 + SOFTENING * h**2), max=0)
        mean = (listed.at_receivers(density) + listed.at_senders(density)) / 2
        return mu * (self.beta.abs() * mu - self.alpha.abs() * self.c) / mean
