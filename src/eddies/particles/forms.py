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
    kernel : the learned W. Only averages accept negative weights.
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

    def of(self, field: ParticleField) -> Reconstructed:
        """Reconstruct the velocity of the particles of a field; collective."""
        return Reconstructed(self, field)


class Reconstructed:
    """Velocity reconstructed from particles at one moment. All methods are collective."""

    def __init__(self, form: Form, field: ParticleField) -> None:
        self.form, self.field = form, field
        self._volume = field.volumes(form.kernel) if form.name == "average" else None

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and gradient (k, 3, 3) [component, direction] at points (k, 3) of this rank."""
        if self._volume is not None:
            return self.field.averaged(self.form.kernel, self._volume, points)
        return self._kriged(points) if self.form.name == "kriging" else self._fitted(DEGREES[self.form.name], points)

    def velocity_on_grid(self) -> Tensor:
        """Velocity (m, 3) at this rank's grid points, z slowest."""
        if self._volume is not None:
            return self.field.velocity_on_whole_grid(self.form.kernel, self._volume)
        return self.at(self.field.points)[0]

    def at_particles(self) -> tuple[Tensor, Tensor]:
        """Velocity (n, 3) and gradient (n, 3, 3) at the owned particles."""
        return self.at(self.field.owned)

    def _fitted(self, degree: int, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.field.fitted(self.form.kernel, degree, self.form.mean_volume, points)

    def _kriged(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Kriging; a quadratic fit where there are too many neighbours or the equations are singular."""
        velocity, gradient = self.field.kriged(self.form.filter_width, points)
        solved = velocity.isfinite().all(1) & gradient.isfinite().all(2).all(1)
        failed = torch.nonzero(~solved).squeeze(1)
        if len(failed):
            log.warning("kriging: %d of %d points have too many neighbours or singular equations; a quadratic fit "
                        "replaces kriging there", len(failed), len(points))
            velocity[failed], gradient[failed] = self._fitted(2, points[failed])
        return velocity, gradient
