"""Terms for the ladder from the published system to forms that hold: each changes one thing of the published system.

The scene `ladder.toml` beside this file names them by their import paths. All are terms of a user: nothing in the
package knows them.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch

import eddies
from eddies.particles.context import Context
from eddies.particles.terms.eddy_viscosity import DensityDiffusion, EddyViscosity
from eddies.particles.terms.pair_network import DensityFlux, PairNetwork
from eddies.particles.terms.sph import TransportVelocity
from eddies.scene import terms as declared

NEAREST = 60


class _Nearest:
    """A sum over the 60 nearest neighbours only, as in the public code. The radius must hold more of them."""

    def __init__(self, settings, flow) -> None:
        super().__init__(settings, flow)
        self.mutual = False  # j may be among the nearest of i, and i not among those of j

    def pair_values(self, pairs) -> torch.Tensor:
        listed = pairs.pairs
        by_distance = torch.argsort(listed.distance.detach())
        order = by_distance[torch.argsort(listed.segment[by_distance], stable=True)]
        place = torch.empty_like(order)
        place[order] = torch.arange(len(order), device=order.device) - listed.offsets[listed.segment[order]]
        return super().pair_values(pairs) * (place < NEAREST)


class NearestForce(_Nearest, PairNetwork):
    """The learned force between pairs, of the 60 nearest neighbours."""


class NearestViscosity(_Nearest, EddyViscosity):
    """The term Pi in the equation of the velocity, of the 60 nearest neighbours."""


class NearestFlux(_Nearest, DensityFlux):
    """The learned density rate, of the 60 nearest neighbours."""


class NearestDiffusion(_Nearest, DensityDiffusion):
    """The term Pi in the equation of the density, of the 60 nearest neighbours."""


@dataclass(frozen=True, kw_only=True)
class OfDensity(eddies.TermSettings):
    """A term that gives the rate of a stored density."""

    reads = ("pairs", "density")
    gives = ("density_rate",)


class Steady(eddies.Term):
    """d rho_i/dt = 0: each particle keeps the density that it has at the start."""

    Settings = OfDensity

    def forward(self, context) -> eddies.Rates:
        return eddies.Rates(density_rate=torch.zeros_like(context.particles.velocity[:, 0]))


class Decay(eddies.Term):
    """The decay of the density to its mean, d rho_i/dt = -C (2 u'/d) (rho_i - rho_0), with a learned C."""

    Settings = OfDensity
    linear = True

    def __init__(self, settings, flow) -> None:
        super().__init__(settings, flow)
        self.factor = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context) -> eddies.Rates:
        scales = context.flow.scales
        excess = context.density - scales.density_mean
        rate = 2 * scales.velocity / scales.filter_width * self.factor.to(excess)
        return eddies.Rates(density_rate=-rate * excess)


@dataclass(frozen=True, kw_only=True)
class OfPressure(eddies.TermSettings):
    """A term that gives the density from the resolved velocity."""

    reads = ("resolved",)
    gives = ("density",)


class PressureDensity(eddies.Term):
    """The density rho_0 (1 + p/c^2) of the pressure of the resolved velocity, without the force of this pressure."""

    Settings = OfPressure

    def forward(self, context) -> eddies.Rates:
        return eddies.Rates(pressure_modes=context.resolved.grid.pressure_of(context.resolved.products))


@dataclass(frozen=True, kw_only=True)
class NeighborMeanSettings(eddies.TermSettings):
    """A term that needs neighbours only."""

    reads = ("pairs",)


class NeighborMean(eddies.PairTerm):
    """The relaxation to the mean of the neighbours, -C (2 u'/d) (v_i - sum_j w v_j / sum_j w), with a learned C."""

    Settings = NeighborMeanSettings
    linear = True
    parity = torch.tensor([1.0, -1.0, -1.0, -1.0])

    def __init__(self, settings, flow) -> None:
        super().__init__(settings, flow)
        self.factor = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def pair_values(self, pairs) -> torch.Tensor:
        return pairs.weight * torch.cat([torch.ones_like(pairs.weight)[None], pairs.velocity_difference])

    def rates_of(self, sums, context) -> eddies.Rates:
        scales = context.flow.scales
        rate = 2 * scales.velocity / scales.filter_width * self.factor.to(sums)
        return eddies.Rates(acceleration=-rate * (sums[1:] / sums[0].clamp_min(1e-9)).T)


@dataclass(frozen=True, kw_only=True)
class SpreadSettings(declared.TransportVelocity):
    """The keys of [model.Spread]."""

    word = ""
    learns_through_horizons = False

    strength: float = eddies.number("p_b delta_t in units of rho_0 c h", default=0.05, at_least=0)
    carried: bool = eddies.boolean("whether the velocity stays that of the field at the shifted particle", default=True)


class Spread(TransportVelocity):
    """The shift to sparser places with a fixed strength. Without `carried` only positions change, as in the relaxation
    steps of NeuralSPH (Toshev et al. 2024)."""

    Settings = SpreadSettings

    def __init__(self, settings, flow) -> None:
        super().__init__(settings, flow)
        self.background = torch.nn.Parameter(torch.tensor(settings.strength, dtype=torch.float64), requires_grad=False)

    def rates_of(self, sums, context) -> eddies.Rates:
        rates = super().rates_of(sums, context)
        return rates if self.settings.carried else replace(rates, shift_acceleration=None)


@dataclass(frozen=True, kw_only=True)
class NoisySettings(declared.PairNetwork):
    """The keys of [model.NoisyForce]: those of the force, and the noise."""

    word = ""

    noise: float = eddies.number("rms of the noise of a velocity component, in units of u'", default=0.05, at_least=0)
    time: float = eddies.number("time in which the force takes the noise back, in units of d/(2 u')", default=1.0,
                                above=0)


class NoisyForce(PairNetwork):
    """The learned force, trained with noise in its velocities that it has to take back (Sanchez-Gonzalez et al. 2020).

    While gradients are recorded, each velocity has noise n, and the force is compared with a_true - n/tau. The noise
    depends on the seed, the number of the evaluation and the id of the particle, so a ghost has that of its original.
    """

    Settings = NoisySettings

    def __init__(self, settings, flow) -> None:
        super().__init__(settings, flow)
        self.seed, self.evaluations = flow.seed, 0

    def forward(self, context) -> eddies.Rates:
        settings, particles, scales = self.settings, context.particles, context.flow.scales
        if not torch.is_grad_enabled():
            return super().forward(context)
        self.evaluations += 1
        random = np.random.default_rng([self.seed, self.evaluations])
        drawn = torch.as_tensor(random.standard_normal((int(particles.id.max()) + 1, 3)))[particles.id]
        noise = settings.noise * scales.velocity * drawn.to(particles.velocity)
        noisy = Context(context.decomposition, replace(particles, velocity=particles.velocity + noise), context.flow,
                        context.local, None, context.rows, context.dtype, context.density)
        rates = super().forward(noisy)
        rate = 2 * scales.velocity / (scales.filter_width * settings.time)
        own = noise if context.rows is None else noise[context.rows]
        return replace(rates, acceleration=rates.acceleration + rate * own.to(rates.acceleration))
