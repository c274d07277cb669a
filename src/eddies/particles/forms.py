"""Methods of reconstruction ("forms"): velocities and their gradients from particles, behind one interface."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import torch
from torch import Tensor

from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import SmoothingKernel

log = logging.getLogger("eddies")

DEGREES = {"linear": 1, "quadratic": 2}
WORDS = {"average": "averages with the learned kernel", "kriging": "kriging among neighbours",
         **{name: f"polynomials of degree {degree} fitted to neighbours" for name, degree in DEGREES.items()}}


@dataclass(frozen=True)
class Form:
    """A way to reconstruct the velocity from the particles within the support of the kernel.

    Parameters
    ----------
    name : "average", Eqs. 5 and 6; "linear" or "quadratic", moving least squares (`ParticleField.fitted`); or
        "kriging", the best linear estimate for the covariance of filtered turbulence.
    kernel : the learned kernel W. Only the form "average" accepts a W with negative values.
    filter_width : d of the filter that the velocities have passed.
    mean_volume : mean volume of a particle.
    """

    name: str
    kernel: SmoothingKernel
    filter_width: float
    mean_volume: float

    @property
    def words(self) -> str:
        return WORDS[self.name]

    @property
    def support(self) -> float:
        return self.kernel.support

    def at(self, field: ParticleField, points: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruct the velocity (k, 3) and its gradient (k, 3, 3) [component, direction] at points (k, 3) of this
        rank, from the particles of `field`; collective."""
        if self.name == "average":
            return field.averaged(self.kernel, points)
        if self.name == "kriging":
            return self._kriged(field, points)
        return field.fitted(self.kernel, DEGREES[self.name], self.mean_volume, points)

    def on_grid(self, field: ParticleField) -> Tensor:
        """Reconstruct the velocity (m, 3) at this rank's grid points, z slowest, from the particles of `field`;
        collective."""
        if self.name == "average":
            return field.averaged_on_grid(self.kernel)
        return self.at(field, field.points)[0]

    def _kriged(self, field: ParticleField, points: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruct as in `at`, by kriging. A quadratic fit replaces it at points where a neighbourhood has too many
        particles or the equations are singular."""
        velocity, gradient = field.kriged(self.filter_width, points)
        solved = velocity.isfinite().all(1) & gradient.isfinite().all(2).all(1)
        failed = torch.nonzero(~solved).squeeze(1)
        if len(failed):
            log.warning("kriging: %d of %d points have too many neighbours or singular equations; a quadratic fit "
                        "replaces kriging there", len(failed), len(points))
            velocity[failed], gradient[failed] = field.fitted(self.kernel, 2, self.mean_volume, points[failed])
        return velocity, gradient
