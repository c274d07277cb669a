"""A smooth field and its derivatives at particles, or where none sits, from its values at neighbours, by kriging."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels.kriging import MOST_NEIGHBORS, kriging_weights, told
from eddies.kernels.library import library
from eddies.particles.devices import kernels_serve
from eddies.particles.moments import ENTRIES
from eddies.particles.pairs import Pairs

# Rows of weights: of the field itself, then of its first and of its second derivatives, xx, xy, xz, yy, yz, zz; those
# of the field and its gradient.
OWN, FIRST, SECOND, UP_TO_FIRST = 0, slice(1, 4), slice(4, 10), slice(0, 4)
# Rows of the entries (j, k) of a symmetric matrix.
PLACES = ((0, 1, 2), (1, 3, 4), (2, 4, 5))

# What is no part of the field, as a share of its variance: what the smallest distances of particles at random ask for.
NOISE = 1e-3
# Squared lengths of the Gaussians that make up the covariance, in those of the narrowest of all fields that have passed
# the filter, which a Gaussian filter leaves of white noise: each twice the one before.
NARROWEST, SCALES = 1.2, 6
# Of a particle's own value among its neighbours, in units of the inverse variance of the field.
LEAST_WEIGHT = 0.01
# Receivers that torch solves for at once.
TOGETHER = 256


@dataclass(frozen=True)
class Covariance:
    """C(r) = sum_m amplitudes[m] exp(-slowest 2^m r^2), C(0) = 1, from the widest to the narrowest part.

    `of_filtered_turbulence` is that of a velocity with E(k) ~ k^(-5/3) after a Gaussian filter of width d, whatever its
    variance: a spectrum k^(-5/3) is a sum of Gaussians of lengths l with weights l^(2/3), none narrower than d/sqrt(6),
    as E G^2 ~ exp(-k^2 d^2/12).
    """

    slowest: float
    amplitudes: tuple[float, ...]

    @classmethod
    def of_filtered_turbulence(cls, width: float) -> Covariance:
        """That of a filter of this width."""
        squares = [width**2 / 6 * NARROWEST * 2.0**m for m in reversed(range(SCALES))]
        weights = [square ** (1 / 3) for square in squares]
        return cls(1 / (2 * squares[0]), tuple(weight / sum(weights) for weight in weights))

    def derivatives(self, square: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """C, C' and C'' as functions of r^2."""
        rates = [self.slowest * 2**m for m in range(len(self.amplitudes))]
        parts = [amplitude * torch.exp(-rate * square) for rate, amplitude in zip(rates, self.amplitudes)]
        return (torch.stack(parts).sum(0), torch.stack([-rate * part for rate, part in zip(rates, parts)]).sum(0),
                torch.stack([rate**2 * part for rate, part in zip(rates, parts)]).sum(0))


def noise_at(distance: Tensor, support: float) -> Tensor:
    """Variance of the noise of a neighbour: ten times that of the field at the support, where they come and go."""
    return NOISE / (1 - (distance / support) ** 4).clamp_min(1e-4)


@torch.no_grad()
def weights(pairs: Pairs, support: float, covariance: Covariance) -> tuple[Tensor, Sequence[Tensor]]:
    """By which weights of the values f_j at a particle and its neighbours what is asked for there is told best:
    sum_j w_j f_j, w = K^-1 b, K_jk = C(|x_j - x_k|) plus the noise of each on the diagonal.

    Of f itself b is 1 for the particle and 0 for its neighbours: f_i less what the neighbours alone tell of it, times
    w_i. Of derivatives b is that of C(|x - x_j|) by x at the particle. The mean of f is not known: from w is taken of
    K^-1 1 what lets weights add up to nothing, so that a constant has no derivatives (ordinary kriging).

    Returns the particles' own weights (10, k) and the neighbours', ten of (m,), of the field itself, its first and
    its second derivatives xx, xy, xz, yy, yz, zz. They are NaN where equations cannot be solved, or there are more than
    MOST_NEIGHBORS: what is wrong with one particle is for all ranks to say.
    """
    return _weights(pairs, support, covariance, sited=True)


@torch.no_grad()
def interpolated(pairs: Pairs, support: float, covariance: Covariance, sender_values: Tensor) -> tuple[Tensor, Tensor]:
    """A field (n, c) and its gradient (n, c, 3) at receivers that are no particles, from what it is at all local
    particles (s, c): sum_j w_j f_j, w = K^-1 b with K as in `weights` and b_j = C(|x - x_j|), or its derivatives by x.

    The mean is not known: weights of the field add up to one, those of its gradient to nothing, so that a constant is
    exact. NaN where `weights` are; a particle at the receiver's own place is a neighbour like others. Zero where no
    particle lies within the support.
    """
    _, found = _weights(pairs, support, covariance, sited=False)
    rows, values = found[UP_TO_FIRST], sender_values.to(pairs.displacement.dtype)
    if kernels_serve(pairs.displacement.device):
        told_there = torch.from_numpy(told(library(), pairs.offsets.numpy(), pairs.sender.numpy(), None,
                                           [row.numpy() for row in rows], values.contiguous().numpy()))
    else:
        sent = pairs.at_senders(values)
        told_there = torch.stack([pairs.sum(row[:, None] * sent) for row in rows], -1)
    return told_there[..., OWN], told_there[..., FIRST]


def _weights(pairs: Pairs, support: float, covariance: Covariance, sited: bool) -> tuple[Tensor, Sequence[Tensor]]:
    if kernels_serve(pairs.displacement.device):
        found = kriging_weights(library(), pairs.offsets.numpy(), np.ascontiguousarray(pairs.displacement.T.numpy()),
                                support, NOISE, covariance.slowest, np.array(covariance.amplitudes), sited)
        return torch.from_numpy(found[0]), [torch.from_numpy(row) for row in found[1]]
    return solved(pairs.offsets, pairs.displacement, support, covariance, sited)


def solved(offsets: Tensor, displacement: Tensor, support: float, covariance: Covariance,
           sited: bool = True) -> tuple[Tensor, Tensor]:
    """Weights by torch, of displacements (m, 3) x_i - x_j of each receiver's pairs; receivers are particles, or, if not
    `sited`, points without a value of their own."""
    count = len(offsets) - 1
    own, found = displacement.new_empty((10, count)), displacement.new_full((10, len(displacement)), torch.nan)
    for start in range(0, count, TOGETHER):
        edges = offsets[start : start + TOGETHER + 1]
        listed = edges[1:] - edges[:-1]
        crowded = listed > MOST_NEIGHBORS
        listed = torch.where(crowded, 0, listed)
        place = torch.arange(int(listed.max()) if len(listed) else 0, device=offsets.device)
        known = place < listed[:, None]
        pair = (edges[:-1, None] + place)[known]
        away = displacement.new_zeros((len(listed), len(place) + 1, 3))  # the particle itself the first
        away[:, 1:][known] = -displacement[pair]
        known = torch.cat([known.new_full((len(listed), 1), sited), known], 1)
        right, matrix = _equations(away, known, support, covariance)
        factor, failed = torch.linalg.cholesky_ex(matrix)
        factor[failed > 0] = torch.nan  # as the library has it: an error here would be that of one rank alone
        solution = torch.cholesky_solve(right, factor)
        solution, ones = solution[..., :10], solution[..., 10:]
        wanted = solution.new_zeros(10)
        wanted[OWN] = not sited
        solution = solution - ones * ((solution.sum(1, keepdim=True) - wanted) / ones.sum(1, keepdim=True))
        own[:, start : start + len(listed)] = solution[:, 0].T.masked_fill(crowded, torch.nan)
        found[:, pair] = solution[:, 1:][known[:, 1:]].T
    return own, found


def _equations(away: Tensor, known: Tensor, support: float, covariance: Covariance) -> tuple[Tensor, Tensor]:
    """Right-hand sides (k, p, 11), the last all 1, and matrices (k, p, p) of places x_j - x_i that are `known`; the
    first place is the receiver's own, which is known of a particle."""
    value, _, _ = covariance.derivatives((away[:, :, None] - away[:, None]).square().sum(-1))
    both = known[:, :, None] & known[:, None]
    distance = away.norm(dim=-1)
    diagonal = torch.where(known, noise_at(distance, support), 1.0)
    matrix = torch.where(both, value, 0.0) + torch.diag_embed(diagonal)
    towards, first, second = covariance.derivatives(distance.square())
    itself = torch.zeros_like(first)
    itself[:, 0] = 1
    right = [torch.where(known[:, :1], itself, towards), *(-2 * first * away[..., axis] for axis in range(3)),
             *(4 * second * away[..., j] * away[..., k] + (2 * first if j == k else 0) for j, k in ENTRIES),
             torch.ones_like(first)]
    return torch.stack(right, -1) * known[..., None], matrix


class Kriging:
    """What neighbours tell of fields at the owned particles of a rank.

    Parameters
    ----------
    pairs : of all owned particles with those that the rank sees, `seen` in all. support : within which they are.
    filter_width : d of the filter that the fields have passed.
    with_ghosts : what the rank sees of a column of its own particles; collective.

    Everything is linear in the fields, differentiable in them, not in the positions, and collective.
    """

    def __init__(self, pairs: Pairs, seen: int, support: float, filter_width: float,
                 with_ghosts: Callable[[Tensor], Tensor]) -> None:
        self._own, self._others = weights(pairs, support, Covariance.of_filtered_turbulence(filter_width))
        self._seen, self._filter_width = seen, filter_width
        self._offsets, self._senders, self._with_ghosts = pairs.offsets, pairs.sender, with_ghosts

    def derivatives(self, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Fields (n, c) less what the neighbours alone tell of them, nothing where there are none, and their first
        (n, c, 3) and second (n, c, 3, 3) derivatives."""
        found = self._told(self._own, self._others, field)
        # The own weight is the inverse of a variance, 1/12 or more with one neighbour, and nothing alone.
        untold = found[..., OWN] / self._own[OWN, :, None].clamp_min(LEAST_WEIGHT)
        return untold, found[..., FIRST], found[..., SECOND][..., PLACES]

    def gradient(self, field: Tensor) -> Tensor:
        """(n, 3) of a field (n,)."""
        return self._told(self._own[FIRST], self._others[FIRST], field[:, None])[:, 0]

    def laplacian(self, field: Tensor) -> Tensor:
        """(n,) of a field (n,)."""
        own, others = self._laplacian
        return self._told(own[None], [others], field[:, None])[:, 0, 0]

    @cached_property
    def laplacian_bound(self) -> Tensor:
        """The sum of its weights' sizes, (n,), some hundred over d^2; 1/d^2 for a particle alone, which has none."""
        own, others = self._laplacian
        sizes = own.abs() + torch.segment_reduce(others.abs(), "sum", offsets=self._offsets)
        return sizes.clamp_min(self._filter_width**-2)

    @cached_property
    def _laplacian(self) -> tuple[Tensor, Tensor]:
        xx, yy, zz = (SECOND.start + PLACES[axis][axis] for axis in range(3))
        return (self._own[xx] + self._own[yy] + self._own[zz],
                self._others[xx] + self._others[yy] + self._others[zz])

    def _told(self, own: Tensor, others: Sequence[Tensor], field: Tensor) -> Tensor:
        """What rows of weights tell of fields (n, c), (n, c, rows)."""
        seen = self._with_ghosts(field.to(own))
        assert len(seen) == self._seen, "halo and list are not those of the weights"
        if not kernels_serve(seen.device) or torch.is_grad_enabled() and seen.requires_grad:
            return torch.stack([of_own[:, None] * seen[: len(of_own)] + self._matrix(of_others) @ seen
                                for of_own, of_others in zip(own, others)], -1)
        return torch.from_numpy(told(library(), self._offsets.numpy(), self._senders.numpy(), own.numpy(),
                                     [row.numpy() for row in others], seen.detach().contiguous().numpy()))

    def _matrix(self, values: Tensor) -> Tensor:
        with warnings.catch_warnings():  # of torch, that such matrices may change
            warnings.simplefilter("ignore")
            return torch.sparse_csr_tensor(self._offsets, self._senders, values, (len(self._offsets) - 1, self._seen))
