"""Methods of reconstruction ("forms"): velocities and their gradients from particles, behind one interface."""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.reduction import global_sum
from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import SmoothingKernel

log = logging.getLogger("eddies")

WORDS = {"average": "averages with the learned kernel", "kriging": "kriging among neighbours"}


@dataclass(frozen=True)
class Form:
    """A way to reconstruct the velocity from the particles within the support of the kernel.

    Parameters
    ----------
    name : "average", Eqs. 5 and 6; or "kriging", the best linear estimate for the covariance of filtered turbulence.
    kernel : the learned kernel W. Only the form "average" accepts a W with negative values.
    filter_width : d of the filter that the velocities have passed.
    """

    name: str
    kernel: SmoothingKernel
    filter_width: float

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
        return self._kriged(field, points)

    def on_grid(self, field: ParticleField) -> Tensor:
        """Reconstruct the velocity (m, 3) at this rank's grid points, z slowest, from the particles of `field`;
        collective."""
        if self.name == "average":
            return field.averaged_on_grid(self.kernel)
        return self.at(field, field.points)[0]

    def _kriged(self, field: ParticleField, points: Tensor) -> tuple[Tensor, Tensor]:
        """Reconstruct as in `at`, by kriging. The average replaces it at points that have too many neighbours or
        singular equations."""
        velocity, gradient = field.kriged(self.filter_width, points)
        solved = velocity.isfinite().all(1) & gradient.isfinite().all(2).all(1)
        failed = torch.nonzero(~solved).squeeze(1)
        count, total = global_sum(field.decomposition.comm, np.array([len(failed), len(points)]))
        if count:  # on any rank: averages are collective
            log.warning("kriging: %d of %d points have too many neighbours or singular equations; averages replace "
                        "kriging there", count, total)
            velocity[failed], gradient[failed] = field.averaged(self.kernel, points[failed])
        return velocity, gradient
