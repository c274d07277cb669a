"""The forms in which velocities and their gradients are reconstructed from particles, behind one interface."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from eddies.particles.kriging import Covariance
from eddies.particles.particle_field import ParticleField
from eddies.particles.smoothing_kernels import SmoothingKernel

log = logging.getLogger("eddies")

DEGREES = {"linear": 1, "quadratic": 2}


class Reconstructed(Protocol):
    """A velocity made of particles at one moment; collective where it is asked for."""

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Velocity (k, 3) and gradient (k, 3, 3) [component, direction] at points (k, 3) of this rank."""

    def velocity_on_grid(self) -> Tensor:
        """The velocity (m, 3) at this rank's grid points, z slowest."""

    def at_particles(self) -> tuple[Tensor, Tensor]:
        """Velocity (n, 3) and gradient (n, 3, 3) at the owned particles."""


class Form(Protocol):
    """A way to reconstruct a velocity from the particles within `support`; `words` name it."""

    support: float
    words: str

    def of(self, field: ParticleField) -> Reconstructed:
        """What it makes of particles; collective."""


@dataclass(frozen=True)
class Average:
    """Averages with a kernel, Eqs. 5 and 6, as `reconstruct` has them; the gradient of normalised ones is exactly that
    of the reconstructed field."""

    kernel: SmoothingKernel
    words = "averages with the learned kernel"

    @property
    def support(self) -> float:
        """h."""
        return self.kernel.support

    def of(self, field: ParticleField) -> _Averaged:
        """See Form."""
        return _Averaged(self.kernel, field, field.volumes(self.kernel))


@dataclass(frozen=True)
class _Averaged:
    kernel: SmoothingKernel
    field: ParticleField
    volume: Tensor

    def at(self, points: Tensor) -> tuple[Tensor, Tensor]:
        return self.field.averaged(self.kernel, self.volume, points)

    def velocity_on_grid(self) -> Tensor:
        return self.field.velocity_on_whole_grid(self.kernel, self.volume)

    def at_particles(self) -> tuple[Tensor, Tensor]:
        return self.field.at_particles(self.kernel, self.volume)


@dataclass(frozen=True)
class LeastSquares:
    """Moving least squares of a degree, 1 or 2, with a kernel as weight: exact for polynomials of this degree where
    there are enough neighbours. The gradient is that of the polynomial. `mean_volume`: of a particle."""

    kernel: SmoothingKernel
    degree: int
    mean_volume: float

    @property
    def words(self) -> str:
        """That it is of this degree."""
        return f"polynomials of degree {self.degree} fitted to neighbours"

    @property
    def support(self) -> float:
        """h."""
        return self.kernel.support

    def of(self, field: ParticleField) -> _AtAnyPoints:
        """See Form."""
        return _AtAnyPoints(
            field, lambda receivers: field.fitted(self.kernel, self.degree, self.mean_volume, receivers))


@dataclass(frozen=True)
class Kriging:
    """The best linear estimate from neighbours, for the covariance of turbulence that has passed a Gaussian filter.

    At points with too many neighbours, or with singular equations, `instead` is used, and the log says so.
    """

    covariance: Covariance
    instead: LeastSquares
    words = "kriging among neighbours"

    @property
    def support(self) -> float:
        """h."""
        return self.instead.support

    def of(self, field: ParticleField) -> _AtAnyPoints:
        """See Form."""
        return _AtAnyPoints(field, lambda receivers: self._at(field, receivers))

    def _at(self, field: ParticleField, receivers: Tensor) -> tuple[Tensor, Tensor]:
        found = field.kriged(self.covariance, receivers)
        failed = torch.nonzero(~(found[0].isfinite().all(1) & found[1].isfinite().all(2).all(1))).squeeze(1)
        if len(failed):
            log.warning("kriging: of %d points %d have too many neighbours, or equations without a solution; there "
                        "polynomials of second degree are fitted", len(receivers), len(failed))
            for whole, part in zip(found, self.instead.of(field).at(receivers[failed])):
                whole[failed] = part
        return found


class _AtAnyPoints:
    """What needs no more than the particles around a point, wherever that lies on this rank."""

    def __init__(self, field: ParticleField, at: Callable[[Tensor], tuple[Tensor, Tensor]]) -> None:
        self._field, self.at = field, at

    def velocity_on_grid(self) -> Tensor:
        return self.at(self._field.points)[0]

    def at_particles(self) -> tuple[Tensor, Tensor]:
        return self.at(self._field.owned)


def form_of(name: str, kernel: SmoothingKernel, filter_width: float, mean_volume: float) -> Form:
    """The form that [kernel] form names: "average", "linear", "quadratic" or "kriging".

    Parameters
    ----------
    kernel : the learned W. All forms use the particles within its support. Only averages accept negative weights.
    filter_width : d of the filter that the velocities have passed. mean_volume : of a particle.
    """
    if name == "average":
        return Average(kernel)
    if name == "kriging":
        return Kriging(Covariance.of_filtered_turbulence(filter_width), LeastSquares(kernel, 2, mean_volume))
    return LeastSquares(kernel, DEGREES[name], mean_volume)
