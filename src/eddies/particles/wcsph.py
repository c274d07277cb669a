"""Weakly compressible smoothed particle hydrodynamics (WCSPH): pressure from a density that is summed up."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from eddies.particles.pairs import Pairs
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.particles.surroundings import LocalParticles

# Softens the approach rate at small distances, in squared smoothing lengths (Monaghan 1992).
SOFTENING = 0.01
# Pairs taken together in the sum of the density: about a core's cache.
PAIRS_TOGETHER = 1 << 16


class SummationDensity:
    """rho_i = sum_j m W(x_i - x_j), the particle itself counted once.

    Parameters
    ----------
    kernel : W; its support must be that of the pair force, whose list of neighbours is used.
    mass : m of a particle.
    dtype : of the pair arithmetic.
    """

    reads = ()

    def __init__(self, kernel: SmoothingKernel, mass: float, dtype: torch.dtype = torch.float64) -> None:
        self.kernel, self.mass, self.dtype, self.cutoff = kernel, mass, dtype, kernel.support

    def fields(self, particles: ParticleSet, local: LocalParticles) -> dict[str, Tensor]:
        """The "density" (n,) of the owned particles; differentiable in the positions."""
        own = local.position[: len(particles)]
        sums = []
        for block in local.neighbors.blocks(PAIRS_TOGETHER):
            pairs = local.neighbors.pairs(own, local.position, block, self.dtype)
            sums.append(pairs.sum(self.kernel.value(pairs.distance)))
        others = torch.cat(sums)
        itself = self.kernel.value(others.new_zeros(()))
        return {"density": (self.mass * (others + itself)).to(particles.density.dtype)}


class WCSPH(nn.Module):
    """Pressure and artificial viscosity of WCSPH (Monaghan 1992),

        dv_i/dt = -sum_j m (P_i/rho_i^2 + P_j/rho_j^2 + Pi_ij) grad W(x_i - x_j)
        P = c^2 rho_0/gamma ((rho/rho_0)^gamma - 1)
        Pi_ij = (-alpha c mu + beta mu^2)/mean(rho_i, rho_j),   mu = h x.v/(r^2 + 0.01 h^2)

    Pi only for approaching pairs, x.v < 0. The smoothing length h is half the kernel's support. Forces of a pair are
    opposite and central, so momentum and angular momentum are kept. In three dimensions Pi acts like a viscosity of
    about alpha c h / 10.

    Parameters
    ----------
    kernel : W. mass : m. density : rho_0.
    sound_speed, alpha, beta, exponent : c, alpha, beta, gamma; parameters in double precision, which can be learned.
    """

    reads = ("velocity", "density")
    width = 8
    # The forces of a pair are opposite, so each pair is evaluated once.
    mutual = True
    parity = -torch.ones(3)

    def __init__(self, kernel: SmoothingKernel, mass: float, density: float, sound_speed: float, alpha: float = 1.0,
                 beta: float = 2.0, exponent: float = 7.0) -> None:
        super().__init__()
        self.kernel, self.mass, self.density, self.cutoff = kernel, mass, density, kernel.support
        self.sound_speed, self.alpha, self.beta, self.exponent = (
            nn.Parameter(torch.tensor(value, dtype=torch.float64)) for value in (sound_speed, alpha, beta, exponent))

    def forward(self, pairs: Pairs, columns: dict[str, Tensor]) -> dict[str, Tensor]:
        """The acceleration "velocity" (count, 3); `columns` holds the local `velocity` (s, 3) and `density` (s,)."""
        return self.rates(pairs.sum(self.pair_values(pairs, columns).T).T)

    def rates(self, sums: Tensor) -> dict[str, Tensor]:
        """The acceleration from the sums of the pairs' values (3, count)."""
        return {"velocity": sums.T}

    def pair_values(self, pairs: Pairs, columns: dict[str, Tensor]) -> Tensor:
        """What each pair (i, j) accelerates i by, (3, m)."""
        x = pairs.displacement.T
        density = columns["density"].to(x.dtype)
        push = self.pressure(density) / density**2
        strength = pairs.at_receivers(push) + pairs.at_senders(push)
        strength = strength + self._viscosity(pairs, columns["velocity"], density)
        # The slope of W vanishes at r = 0, so that the quotient is 0 for coincident particles.
        slope = self.kernel.derivative(pairs.distance) / pairs.distance.clamp(min=torch.finfo(x.dtype).tiny)
        return -self.mass * strength * slope * x

    def pressure(self, density: Tensor) -> Tensor:
        """P of densities of any shape."""
        c, gamma, rho_0 = self.sound_speed, self.exponent, self.density
        return c**2 * rho_0 / gamma * ((density / rho_0) ** gamma - 1)

    def _viscosity(self, pairs: Pairs, velocity: Tensor, density: Tensor) -> Tensor:
        """Pi (m,) of the pairs."""
        x, h = pairs.displacement.T, self.kernel.support / 2
        v = (pairs.at_receivers(velocity) - pairs.at_senders(velocity)).T.to(x.dtype)
        mu = torch.clamp(h * (x * v).sum(0) / (pairs.distance**2 + SOFTENING * h**2), max=0)
        mean = (pairs.at_receivers(density) + pairs.at_senders(density)) / 2
        return mu * (self.beta * mu - self.alpha * self.sound_speed) / mean
