"""Kriging: values and derivatives of a smooth field from its values at neighbouring particles."""

import warnings
from collections.abc import Callable, Sequence
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from eddies.kernels import kriging as compiled
from eddies.particles.pairs import Pairs

# Rows of the weights: OWN is for the field itself, FIRST for its first derivatives, and SECOND for its second
# derivatives xx, xy, xz, yy, yz, zz. UP_TO_FIRST is OWN together with FIRST.
OWN, FIRST, SECOND, UP_TO_FIRST = 0, slice(1, 4), slice(4, 10), slice(0, 4)
# Row in SECOND of each entry (j, k) of the matrix of second derivatives.
PLACES = ((0, 1, 2), (1, 3, 4), (2, 4, 5))

# Ratio of the noise variance to the field variance. It must be so large because some random particles almost coincide.
NOISE = 1e-3
# The covariance is a sum of SCALES Gaussians. Each squared length is twice the one before, and NARROWEST is the
# smallest. The unit is d^2/6, the squared correlation length of white noise after the Gaussian filter.
NARROWEST, SCALES = 1.2, 6
# A residual is divided by the particle's own weight, or by this value if the weight is smaller. The unit is the inverse
# variance of the field.
LEAST_WEIGHT = 0.01


def covariance(filter_width: float) -> tuple[float, np.ndarray]:
    """Return b and the amplitudes a (SCALES,) of the covariance C(r) = sum_m a_m exp(-b 2^m r^2), with C(0) = 1.

    C belongs to a velocity with E(k) ~ k^(-5/3) after a Gaussian filter of width d. A covariance with this spectrum is
    a sum of Gaussians of lengths l with weights l^(2/3). The filter multiplies the spectrum by exp(-k^2 d^2/12), so no
    Gaussian is then narrower than d/sqrt(6).
    """
    squares = [filter_width**2 / 6 * NARROWEST * 2.0**m for m in reversed(range(SCALES))]
    weights = [square ** (1 / 3) for square in squares]
    return 1 / (2 * squares[0]), np.array([weight / sum(weights) for weight in weights])


def interpolated(pairs: Pairs, support: float, filter_width: float, values: Tensor) -> tuple[Tensor, Tensor]:
    """Interpolate a field (n, c) and its gradient (n, c, 3) by kriging, at points x that are not particles.

    `values` (s, c) holds f_j of each particle j that the rank sees. Both results are sums sum_j w_j f_j with weights
    w = K^-1 b of `kriging_weights`. For the field b_j is C(|x - x_j|). For the gradient b_j is the derivative of
    C(|x - x_j|) with respect to the point x. The weights of the field add up to one and those of the gradient to zero,
    so a constant field is exact. The result is NaN where the equations cannot be solved, and zero where no particle
    lies within the support.
    """
    _, weights = kriging_weights(pairs, support, filter_width, sited=False)
    sums = torch.from_numpy(compiled.weighted_sums(pairs.offsets.numpy(), pairs.sender.numpy(), None,
                                                   weights[UP_TO_FIRST],
                                                   values.to(pairs.displacement.dtype).contiguous().numpy()))
    return sums[..., OWN], sums[..., FIRST]


def kriging_weights(pairs: Pairs, support: float, filter_width: float,
                    sited: bool = True) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the weights w of the best linear estimate sum_j w_j f_j of a field or of a derivative: w = K^-1 b.

    K_jk is C(|x_j - x_k|) (see `covariance`), plus NOISE / max(1 - (r/support)^4, 1e-4) on the diagonal. This noise
    of a particle grows with its distance r from the receiver, so neighbours enter and leave the support without a jump.
    If the receiver x is a particle i (`sited`), its own value f_i is among the f_j. For the field, b is then 1 for the
    particle and 0 for its neighbours. The sum is then w_i times the difference between f_i and the neighbours'
    estimate. For derivatives, b is the derivative of C(|x - x_j|) with respect to x. The mean of f is unknown. So a
    multiple of K^-1 1 is subtracted from w to make the sum of the weights zero. For the field at a receiver that is
    no particle, the weights add up to one instead (ordinary kriging).

    Returns
    -------
    The receivers' own weights (10, k), and ten arrays (m,) of the neighbours' weights. The ten rows are those of the
    field, its first derivatives, and its second derivatives xx, xy, xz, yy, yz, zz. Weights are NaN where the equations
    cannot be solved or a receiver has more than MOST_NEIGHBORS neighbours.
    """
    displacement = np.ascontiguousarray(pairs.displacement.detach().cpu().T.numpy())
    return compiled.kriging_weights(pairs.offsets.cpu().numpy(), displacement, support, NOISE,
                                    *covariance(filter_width), sited)


class Kriging:
    """Kriging estimates at the owned particles of a rank from their neighbours.

    All estimates are linear in the fields, differentiable in the fields but not in the positions, and collective.

    Parameters
    ----------
    pairs : pairs of all owned particles with the particles that the rank sees, within `support`.
    seen : number of particles that the rank sees.
    filter_width : d of the filter that the fields have passed.
    with_ghosts : appends the ghost rows to a column of the owned particles; collective.
    """

    def __init__(self, pairs: Pairs, seen: int, support: float, filter_width: float,
                 with_ghosts: Callable[[Tensor], Tensor]) -> None:
        own, others = kriging_weights(pairs, support, filter_width)
        self._own, self._others = torch.from_numpy(own), [torch.from_numpy(row) for row in others]
        self._offsets, self._senders = pairs.offsets.cpu(), pairs.sender.cpu()
        self._seen, self._filter_width, self._with_ghosts = seen, filter_width, with_ghosts

    def derivatives(self, field: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the residual (n, c), the first (n, c, 3) and the second (n, c, 3, 3) derivatives of fields (n, c).

        The residual is the field minus the neighbours' estimate of it; it is zero without neighbours.
        """
        rows = self._estimate(self._own, self._others, field)
        # The own weight is an inverse variance: 1/12 or more with one neighbour, and zero without any.
        residual = rows[..., OWN] / self._own[OWN, :, None].clamp_min(LEAST_WEIGHT).to(rows)
        return residual, rows[..., FIRST], rows[..., SECOND][..., PLACES]

    def gradient(self, field: Tensor) -> Tensor:
        """Return the gradient (n, 3) of a field (n,)."""
        return self._estimate(self._own[FIRST], self._others[FIRST], field[:, None])[:, 0]

    def laplacian(self, field: Tensor) -> Tensor:
        own, others = self._laplacian
        return self._estimate(own[None], [others], field[:, None])[:, 0, 0]

    @cached_property
    def laplacian_bound(self) -> Tensor:
        """Sum (n,) of the magnitudes of the weights of the Laplacian, or 1/d^2 if the sum is smaller."""
        own, others = self._laplacian
        sizes = own.abs() + torch.segment_reduce(others.abs(), "sum", offsets=self._offsets)
        return sizes.clamp_min(self._filter_width**-2)

    @cached_property
    def _laplacian(self) -> tuple[Tensor, Tensor]:
        xx, yy, zz = (SECOND.start + PLACES[axis][axis] for axis in range(3))
        return (self._own[xx] + self._own[yy] + self._own[zz],
                self._others[xx] + self._others[yy] + self._others[zz])

    def _estimate(self, own: Tensor, others: Sequence[Tensor], field: Tensor) -> Tensor:
        """Return own_i f_i + sum_j others_ij f_j for fields f (n, c) and each row of the weights: (n, c, rows)."""
        seen = self._with_ghosts(field.to(own.dtype)).cpu()
        assert len(seen) == self._seen, "the weights belong to another halo or neighbour list"
        if torch.is_grad_enabled() and seen.requires_grad:
            rows = [own_row[:, None] * seen[: len(own_row)] + self._matrix(row) @ seen
                    for own_row, row in zip(own, others)]
            return torch.stack(rows, -1).to(field.device)
        rows = compiled.weighted_sums(self._offsets.numpy(), self._senders.numpy(), own.numpy(),
                                      [row.numpy() for row in others], seen.detach().contiguous().numpy())
        return torch.from_numpy(rows).to(field.device)

    def _matrix(self, values: Tensor) -> Tensor:
        with warnings.catch_warnings():  # torch announces that sparse matrices are experimental
            warnings.simplefilter("ignore")
            return torch.sparse_csr_tensor(self._offsets, self._senders, values, (len(self._offsets) - 1, self._seen))
