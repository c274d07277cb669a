"""The periodic cube that particles live in."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class PeriodicBox:
    """Cube of side `length`, periodic in x and y, and in z unless `periodic_z` is False.

    A rank that holds one slab of several receives its neighbours' particles with z already moved to where
    they are seen from the slab, so there z is an ordinary coordinate.
    """

    length: float
    periodic_z: bool = True

    @property
    def periodic(self) -> tuple[bool, bool, bool]:
        """Whether x, y and z are periodic."""
        return True, True, self.periodic_z

    def nearest_image(self, difference: Tensor, axis: int) -> Tensor:
        """Differences of one coordinate (any shape), moved by whole periods to the smallest magnitude."""
        if not self.periodic[axis]:
            return difference
        return difference - self.length * torch.round(difference / self.length)

    def displacement(self, a: Tensor, b: Tensor) -> Tensor:
        """a - b (..., 3) between nearest images; differentiable in both."""
        difference = a - b
        return torch.stack([self.nearest_image(difference[..., axis], axis) for axis in range(3)], dim=-1)

    def wrap(self, positions: Tensor) -> Tensor:
        """Positions (..., 3) moved by whole periods into [0, length) along the periodic axes."""
        wrapped = torch.remainder(positions, self.length)
        # The remainder of a tiny negative number rounds to `length` itself.
        wrapped = torch.where(wrapped >= self.length, torch.zeros_like(wrapped), wrapped)
        if self.periodic_z:
            return wrapped
        return torch.cat([wrapped[..., :2], positions[..., 2:]], dim=-1)


def safe_norm(vectors: Tensor, dim: int = -1) -> Tensor:
    """Euclidean length along `dim`; its gradient at a zero vector is zero instead of undefined."""
    square = (vectors * vectors).sum(dim)
    zero = square == 0
    return torch.where(zero, square, torch.sqrt(torch.where(zero, torch.ones_like(square), square)))
