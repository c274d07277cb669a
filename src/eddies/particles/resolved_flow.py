"""The velocity that particles resolve, at one moment, and what terms ask of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from eddies.particles.exchanges import sum_over_ranks
from eddies.particles.fourier_grid import FourierGrid, Points


@dataclass(frozen=True)
class ResolvedFlow:
    """The resolved velocity at one moment.

    Parameters
    ----------
    grid : of its modes.
    velocity : modes (3, kz, ky, kx), solenoidal, |k| <= `grid.resolved`.
    points : of the owned particles on the grid.
    relative_velocity : (n, 3), theirs less its mean over all particles.
    filter_width : d of the filter that the particles' velocity has passed.
    left_over : (n, 3), what `missing` gives, where it is known.
    iterations : that the solve took. residual : that it ended with, relative to the velocities. converged : whether
        that is as little as was asked for.
    """

    grid: FourierGrid
    velocity: Tensor
    points: Points
    relative_velocity: Tensor
    filter_width: float
    left_over: Tensor | None = None
    iterations: int = 0
    residual: float = 0.0
    converged: bool = True

    def at_particles(self, modes: Tensor) -> Tensor:
        """Values (n, c) of modes (c, kz, ky, kx) at the particles; collective, differentiable."""
        return self.grid.at(modes, self.points)

    def missing(self) -> Tensor:
        """What the grid does not resolve of the particles' velocities relative to their mean: (n, 3); collective."""
        if self.left_over is not None:
            return self.left_over
        return self.relative_velocity - self.at_particles(self.velocity).to(self.relative_velocity)

    @cached_property
    def spectrum(self) -> Tensor:
        """E(k), the energy of the modes with |k| rounding to k = 0, 1, ..., k_c, of which the last shell holds only
        those up to k_c; sum E = <u.u>/2 of the resolved velocity. (k_c + 1,), over all ranks; collective,
        differentiable."""
        grid = self.grid
        energy = 0.5 * grid.multiplicity * (self.velocity.real.square() + self.velocity.imag.square()).sum(0)
        shell = torch.round(grid.shell).long()
        inside = shell <= grid.resolved
        spectrum = energy.new_zeros(grid.resolved + 1, dtype=torch.float64)
        return sum_over_ranks(grid.decomposition.comm, spectrum.index_add(0, shell[inside], energy[inside].double()))

    @cached_property
    def products(self) -> Tensor:
        """Modes (6, kz, ky, kx) of u_i u_j; collective, differentiable."""
        return self.grid.squares(self.velocity)

    @cached_property
    def convection(self) -> Tensor:
        """Modes (3, kz, ky, kx) of d_j (u_i u_j); collective, differentiable."""
        return self.grid.stress_divergence(self.products)

    @property
    def filter_transfer(self) -> Tensor:
        """The filter's G of each mode (kz, ky, kx)."""
        return self.grid.filter_transfer(self.filter_width)

    @cached_property
    def unfiltered(self) -> Tensor:
        """Modes (3, kz, ky, kx) of u* = u / G."""
        return self.velocity * (1 / self.filter_transfer)  # complex numbers are divided ten times slower

    @cached_property
    def rms(self) -> Tensor:
        """Root mean square of a component of the resolved velocity; collective, differentiable."""
        return self._rms_of(self.velocity, 0)

    @cached_property
    def smallest_rms(self) -> Tensor:
        """The same of the smallest scales, of the modes of u* with |k| > k_c/2."""
        return self._rms_of(self.unfiltered, self.grid.resolved / 2)

    def mean_square(self, modes: Tensor, above: float, below: float = math.inf) -> Tensor:
        """Mean of u.u of those modes of a vector with `above` < |k| < `below`, in units of the smallest wavenumber;
        collective, differentiable."""
        square = (modes.real.square() + modes.imag.square()).sum(0) * self.grid.multiplicity
        inside = (self.grid.shell > above) & (self.grid.shell < below)
        return sum_over_ranks(self.grid.decomposition.comm,
                              torch.where(inside, square, 0.0).sum(dtype=torch.float64))

    def _rms_of(self, modes: Tensor, above: float) -> Tensor:
        # Where nothing moves the slope of the root is taken for zero.
        return (self.mean_square(modes, above) / 3).clamp_min(1e-300).sqrt()
