"""Smoothed particle hydrodynamics: the density equation, the forces of WCSPH, and a transport velocity.

W is the cubic spline. Its support is the radius of interaction, and the smoothing length h is half of it. m is the mass
of a particle and c the sound speed of the flow.
"""

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import CompiledSum, Pairs, ScaledPairs
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import CubicSpline, over_distance
from eddies.particles.terms.term import Coefficient, PairTerm
from eddies.scene import terms as declared
from eddies.scene.terms import TermSettings

# This number is added to r^2 in the denominator of mu, to limit mu at small distances; in units of h^2 (Monaghan 1992).
SOFTENING = 0.01
# Initial value of p_b delta_t / (rho_0 c h) in TransportVelocity.
BACKGROUND = 0.25


class _SPHTerm(PairTerm):
    """A sum over neighbours with the gradient of W. Each pair is evaluated once."""

    mutual = True

    def __init__(self, settings: TermSettings, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.kernel, self.mass = CubicSpline(flow.cutoff), flow.particle_mass
        self.c = flow.scales.required("sound_speed")

    def slope(self, listed: Pairs) -> Tensor:
        return self.mass * over_distance(self.kernel.derivative(listed.distance), listed.distance)

    def densities(self, pairs: ScaledPairs) -> tuple[Tensor, Tensor]:
        """rho_i and rho_j of each pair, (pairs,)."""
        density = pairs.column("density").to(pairs.pairs.distance)
        return pairs.pairs.at_receivers(density), pairs.pairs.at_senders(density)


class Continuity(_SPHTerm):
    """The density equation  d rho_i/dt = rho_i sum_j (m/rho_j) (v_i - v_j).grad W  (Monaghan 2005). If the setting
    `diffusion` is above 0, the right-hand side also has the term of delta-SPH (Molteni & Colagrossi 2009),

        + 2 delta h c sum_j (m/rho_j) (rho_j - rho_i) (-W'/r).

    delta is the only learned parameter; `diffusion` is its initial value. The term uses |delta|, since a negative delta
    would amplify noise.
    """

    Settings = declared.Continuity
    settings: declared.Continuity

    def __init__(self, settings: declared.Continuity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.diffusivity = flow.cutoff * self.c  # 2 h c
        self.delta = nn.Parameter(torch.tensor(settings.diffusion, dtype=torch.float64)) if settings.diffusion else None
        self.parity = torch.tensor([1.0] if self.delta is None else [1.0, -1.0])

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        return [] if self.delta is None else [Coefficient.of(
            "|delta|", self.delta.abs(), "diffusivity 2 |delta| h c of the density", "L^2/T", self.diffusivity)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """m (v_i - v_j).grad W and, with diffusion, m (rho_j - rho_i) W'/r, each divided by rho_i rho_j."""
        listed, (own, other) = pairs.pairs, self.densities(pairs)
        slope = self.slope(listed) / (own * other)
        values = [slope * (listed.displacement.T * pairs.velocity_difference).sum(0)]
        return torch.stack(values if self.delta is None else [*values, slope * (other - own)])

    def compiled(self, context: Context) -> CompiledSum:
        scales, support = context.flow.scales, self.kernel.support
        width, unit = scales.filter_width, self.mass / support**5
        return CompiledSum("continuity", (support / width, unit * width * scales.velocity, unit),
                           scalars=(context.column("density"),))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        density = context.own_density.to(sums)
        rate = density**2 * sums[0]
        if self.delta is not None:
            rate = rate - self.delta.abs() * self.diffusivity * density * sums[1]
        return Rates(density_rate=rate.to(context.particles.velocity.dtype))


class WCSPH(_SPHTerm):
    """Pressure and artificial viscosity of weakly compressible SPH (Monaghan 1992),

        dv_i/dt = -sum_j m (P_i/rho_i^2 + P_j/rho_j^2 + Pi_ij) grad W(x_i - x_j)
        P = c_P^2 rho_0/gamma ((rho/rho_0)^gamma - 1)
        Pi_ij = (-alpha c mu + beta mu^2)/mean(rho_i, rho_j),   mu = h x.v/(r^2 + 0.01 h^2),   if x.v < 0

    with x = x_i - x_j, v = v_i - v_j and r = |x|. The forces on the two particles of a pair are opposite and central:
    momentum and angular momentum are conserved. In three dimensions Pi acts like a viscosity of about alpha c h / 10.
    The learned parameters are c_P/c, alpha and beta. The term uses their magnitudes, so that friction dissipates. Pi
    contains the c of the flow. If it contained c_P, training could combine a large alpha with a small c_P, and the
    pressure would vanish. gamma is fixed, since it has no effect where the density hardly varies.

    The sum P_i/rho_i^2 + P_j/rho_j^2 gives a poor pressure gradient among random particles. Differences
    (P_j - P_i)/(rho_i rho_j) halve the error at single moments, but they do not conserve energy: the energy grows until
    the rollout stops. A shift that keeps the particles in order prevents this growth, but with it the differences bring
    no advantage.
    """

    Settings = declared.WCSPH
    settings: declared.WCSPH
    parity = -torch.ones(3)

    def __init__(self, settings: declared.WCSPH, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.sound_speed, self.alpha, self.beta = (nn.Parameter(torch.tensor(value, dtype=torch.float64))
                                                   for value in (settings.speed, settings.alpha, settings.beta))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        return [Coefficient.of("|c|", self.sound_speed.abs(), "sound speed of the pressure; learned relative to that "
                               "of the flow", "L/T", self.c),
                Coefficient.of("|alpha|", self.alpha.abs(), "linear artificial viscosity, about alpha c h / 10"),
                Coefficient.of("|beta|", self.beta.abs(), "quadratic artificial viscosity")]

    def pressure(self, density: Tensor) -> Tensor:
        c, gamma, rho_0 = self.c * self.sound_speed, self.settings.exponent, self.flow.scales.density_mean
        return c**2 * rho_0 / gamma * ((density / rho_0) ** gamma - 1)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        listed, (own, other) = pairs.pairs, self.densities(pairs)
        push = self.pressure(own) / own**2 + self.pressure(other) / other**2
        h, x = self.kernel.support / 2, listed.displacement.T
        approach = (x * pairs.velocity_difference).sum(0)
        mu = torch.clamp(h * approach / (listed.distance**2 + SOFTENING * h**2), max=0)
        viscosity = mu * (self.beta.abs() * mu - self.alpha.abs() * self.c) / ((own + other) / 2)
        return -(push + viscosity) * self.slope(listed) * x

    def compiled(self, context: Context) -> CompiledSum:
        scales, density, support = context.flow.scales, context.column("density"), self.kernel.support
        width = scales.filter_width
        numbers = support / width, self.mass * width / support**5, SOFTENING * (support / (2 * width)) ** 2
        viscosity = torch.stack([scales.velocity * self.alpha.abs() * self.c, scales.velocity**2 * self.beta.abs()])
        return CompiledSum("wcsph", numbers, viscosity, (self.pressure(density) / density**2, density))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        return Rates(acceleration=sums.T.to(context.particles.velocity.dtype))


class TransportVelocity(_SPHTerm):
    """Particles move with dx_i/dt = v_i + w_i; the shift velocity w spreads them evenly (Adami, Hu & Adams 2013).

    A constant background pressure p_b that acts for a time delta_t causes w. The velocity v_i changes at the rate
    (w_i.grad) v, so that it remains the velocity of the field at the shifted particle:

        w_i = -(p_b delta_t/m) sum_j (V_i^2 + V_j^2) grad W,   V = m/rho
        (w_i.grad) v = sum_j V_j (v_j - v_i) (w_i.grad W)

    p_b delta_t is learned in units of rho_0 c h. The term uses its magnitude, since particles gather if it is negative.
    The initial value 1/4 is that of Adami et al., with p_b = c^2 rho_0 and a step of h/(4c); here it is used with any
    step. Adami et al. use the divergence of the stress v w instead of (w.grad) v. That form conserves momentum. Its
    part v div w, however, gives random particles a larger error of the velocity than a shift without any correction.
    """

    Settings = declared.TransportVelocity
    parity = torch.tensor([-1.0] * 3 + [1.0] * 9)

    def __init__(self, settings: declared.TransportVelocity, flow: FlowUnits) -> None:
        super().__init__(settings, flow)
        self.unit = flow.scales.density_mean * self.c * flow.cutoff / 2
        self.background = nn.Parameter(torch.tensor(BACKGROUND, dtype=torch.float64))

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        return [Coefficient.of("|p_b delta_t|", self.background.abs(), "background pressure times the time that it "
                               "acts; learned in units of rho_0 c h", "M/(L T)", self.unit)]

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """-m (1/rho_i^2 + 1/rho_j^2) grad W, and the entries of -m (v_i - v_j) grad W^T/(rho_i rho_j); (12, pairs)."""
        listed, (own, other) = pairs.pairs, self.densities(pairs)
        slope = self.slope(listed) * listed.displacement.T
        gradient = pairs.velocity_difference[:, None] * (slope / (own * other))
        return -torch.cat([(own**-2 + other**-2) * slope, gradient.flatten(0, 1)])

    def compiled(self, context: Context) -> CompiledSum:
        scales, support = context.flow.scales, self.kernel.support
        unit = self.mass * scales.filter_width / support**5
        return CompiledSum("transport-velocity", (support / scales.filter_width, unit, unit * scales.velocity),
                           scalars=(context.column("density"),))

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        shift = self.background.abs() * self.unit * sums[:3]
        carried = context.own_density.to(sums) * (sums[3:].unflatten(0, (3, 3)) * shift).sum(1)
        dtype = context.particles.velocity.dtype
        return Rates(shift_velocity=shift.T.to(dtype), shift_acceleration=carried.T.to(dtype))
