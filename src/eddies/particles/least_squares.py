"""Regularised least squares for the solenoidal modes of a velocity that is known at points."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.modes import ModePasses
from eddies.parallel.reduction import global_sum
from eddies.particles.fourier_grid import FourierGrid, Points

# Factor of the penalty in the preconditioner. In the first iterations it suppresses small scales, because the inverse
# filter amplifies their errors most.
SMOOTHING = 5.0


@dataclass(frozen=True)
class Solution:
    """Result of `LeastSquares.solve`.

    Parameters
    ----------
    modes : (3, kz, ky, kx), the solution.
    at_points : (n, 3), values of the solution at the points.
    iterations : number of iterations.
    left : squared residual that remains, as in `LeastSquares.size`.
    """

    modes: Tensor
    at_points: Tensor
    iterations: int
    left: float


class LeastSquares:
    """The normal equations  A u = P B^T v,  A = P B^T B + penalty,  whose solution minimises

        sum_i |v_i - u(x_i)|^2 + sum_k penalty_k |u(k)|^2

    over solenoidal modes u (3, kz, ky, kx), for velocities v_i known at points x_i. B evaluates modes at the points.
    P projects onto the solenoidal modes that are solved for.

    Parameters
    ----------
    inside : bool (kz, ky, kx), whether a mode is solved for. The zeroth mode is the mean of the velocity.
    penalty : (kz, ky, kx), real, 0 for modes that are not solved for.
    """

    def __init__(self, grid: FourierGrid, inside: Tensor, penalty: Tensor) -> None:
        self.grid, self.inside, self.penalty = grid, inside, penalty.to(grid.dtype)
        self._inside = inside.to(grid.dtype)
        scale = torch.where(inside, grid.prefilter * grid.spectral.cells**3, 0.0)
        self._passes = ModePasses(grid.spectral.wavevector, grid.spectral.multiplicity, grid.inverse_squared.numpy(),
                                  scale.numpy(), self.penalty.numpy())

    def gathered(self, values: Tensor, points: Points) -> Tensor:
        """Return P B^T applied to values (n, 3) at points; collective, differentiable."""
        return self.projected(self.grid.spread(values, points) * self.grid.spectral.cells**3)

    def descent(self, missing: Tensor, points: Points, modes: Tensor) -> Tensor:
        """Return half the negative gradient of the minimised sum at `modes` u: P B^T (v - B u) - penalty u.

        `missing` (n, 3) is v - B u. The result vanishes at the minimum. Collective, differentiable.
        """
        if torch.is_grad_enabled():
            return self.gathered(missing, points) - self.penalty * modes
        spread = self.grid.to_modes(points.spread(missing))
        return torch.from_numpy(self._passes.apply(spread.numpy(), -modes.numpy())[0])

    def projected(self, modes: Tensor) -> Tensor:
        """Return P applied to modes; differentiable."""
        return self.grid.solenoidal(modes) * self._inside

    def preconditioner(self, count: float) -> Tensor:
        """1 / (N + 5 penalty), approximately the inverse of A for N = `count` points; 0 for modes not solved for."""
        return torch.where(self.inside, 1 / (count + SMOOTHING * self.penalty), 0.0)

    def size(self, residual: Tensor, count: float) -> float:
        """Return the squared norm of a residual (3, kz, ky, kx) over all ranks; collective.

        The preconditioner for `count` points is the weight, so the result is comparable to sum_i |v_i|^2.
        """
        square = residual.real.square() + residual.imag.square()
        weighted = self.grid.multiplicity * self.preconditioner(count) * square
        return self._over_ranks(float(weighted.sum(dtype=torch.float64)))

    @torch.no_grad()
    def solve(self, points: Points, right: Tensor, count: float, enough: float, iterations: int | None,
              most: int) -> Solution:
        """Solve A y = `right` by preconditioned conjugate gradients, for `count` points over all ranks; collective.

        The iteration ends when the squared residual (`size`) is at most `enough`, or after `most` iterations. If
        `iterations` is given, the solve takes this number of iterations instead.
        """
        inverse, residual = self.preconditioner(count).numpy(), np.array(right.numpy(), order="C")
        modes, direction, passes = np.zeros_like(residual), inverse * residual, self._passes
        at_points = points.position.new_zeros((len(points.position), len(residual)), dtype=torch.float64)
        left, taken = self.size(right, count), 0
        while (left > enough and taken < most) if iterations is None else (taken < iterations and left > 0):
            values = self.grid.at(torch.from_numpy(direction), points)
            applied, product = passes.apply(self.grid.to_modes(points.spread(values)).numpy(), direction)
            length = left / self._over_ranks(product)
            at_points += length * values
            before = left
            left = self._over_ranks(passes.descend(length, inverse, direction, applied, modes, residual))
            passes.update_direction(left / before, inverse, residual, direction)
            taken += 1
        return Solution(torch.from_numpy(modes), at_points, taken, left)

    def _over_ranks(self, value: float) -> float:
        return float(global_sum(self.grid.decomposition.comm, value))
