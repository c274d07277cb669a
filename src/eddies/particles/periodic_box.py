"""The periodic cube of the particles."""

from dataclasses import dataclass

import torch
from torch import Tensor

from eddies.kernels.neighbors import Box


@dataclass(frozen=True)
class PeriodicBox(Box):
    """Cube of side `length`, periodic in x and y, and in z unless `periodic_z` is False.

    On several ranks z is not periodic within a rank: the z of ghosts beyond the periodic face is shifted by one period.
    """

    periodic_z: bool = True

    def nearest_image(self, difference: Tensor, axis: int) -> Tensor:
        """Differences of the coordinate `axis` (any shape), shifted by whole periods to the smallest magnitude."""
        if axis == 2 and not self.periodic_z:
            return difference
        return difference - self.length * torch.round(difference / self.length)

    def displacement(self, a: Tensor, b: Tensor) -> Tensor:
        """a - b (..., 3) between nearest images; differentiable in both."""
        difference = a - b
        return torch.stack([self.nearest_image(difference[..., axis], axis) for axis in range(3)], dim=-1)

    def wrap(self, positions: Tensor) -> Tensor:
        """Positions (..., 3), shifted by whole periods into [0, length) along the periodic axes."""
        wrapped = torch.remainder(positions, self.length)
        # The remainder of a tiny negative number rounds to `length` itself.
        wrapped = torch.where(wrapped >= self.length, torch.zeros_like(wrapped), wrapped)
        return wrapped if self.periodic_z else torch.cat([wrapped[..., :2], positions[..., 2:]], dim=-1)


def safe_norm(vectors: Tensor) -> Tensor:
    """Lengths (...) of vectors (3, ...); the gradient at a zero vector is zero instead of undefined."""
    square = (vectors * vectors).sum(0)
    zero = square == 0
    return torch.where(zero, square, torch.sqrt(torch.where(zero, torch.ones_like(square), square)))
