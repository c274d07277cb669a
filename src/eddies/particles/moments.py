"""Moment matrices of particles' neighbourhoods, which turn differences between particles into derivatives."""

from __future__ import annotations

import torch
from torch import Tensor

# Indices of the six entries of a symmetric 3 x 3 matrix: xx, xy, xz, yy, yz, zz.
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def weight(distance: Tensor, cutoff: float) -> Tensor:
    """Return w = (1 - q^2)^2 with q = distance/cutoff, and 0 for q >= 1."""
    q = distance / cutoff
    return torch.clamp(1 - q * q, min=0) ** 2


def expected_weight(neighbors: float) -> float:
    """Return the sum of w over `neighbors` evenly spread particles within the cutoff. Each adds
    3 int q^2 w dq = 8/35."""
    return neighbors * 8 / 35


def expected_moment(neighbors: float, cutoff: float) -> float:
    """Return a diagonal entry of sum w x x^T for evenly spread neighbours. Each adds
    cutoff^2 int q^4 w dq = 8/315 cutoff^2."""
    return neighbors * cutoff**2 * 8 / 315


def products(a: Tensor, b: Tensor) -> list[Tensor]:
    """Return the six entries a_i b_j, each (m,), of a b^T for parallel vectors a, b (3, m). So a b^T is symmetric."""
    return [a[i] * b[j] for i, j in ENTRIES]


def invert_symmetric(matrix: Tensor) -> Tensor:
    """Return the inverses (6, n) of n symmetric positive definite 3 x 3 matrices, given by their six entries (6, n)."""
    xx, xy, xz, yy, yz, zz = matrix
    cofactors = torch.stack([yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy, xx * zz - xz * xz,
                             xy * xz - xx * yz, xx * yy - xy * xy])
    return cofactors / (xx * cofactors[0] + xy * cofactors[1] + xz * cofactors[2])


def apply_symmetric(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Return the products of symmetric matrices (6, n) with vectors (3, n): (3, n)."""
    xx, xy, xz, yy, yz, zz = matrix
    x, y, z = vectors
    return torch.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])
