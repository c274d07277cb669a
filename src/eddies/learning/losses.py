"""Losses of Eqs. 12 to 15, as this rank's share of a global mean, and the divergence of histograms."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.particles.exchanges import sum_over_ranks


def mean_square_share(error: Tensor, scale: float, total: int) -> Tensor:
    """This rank's share of the mean of (error / scale)^2 over all components of the `total` rows of all ranks.

    The shares of all ranks add up to this mean, Eq. 12 with each component in units of `scale`.
    """
    components = error.shape[1] if error.dim() > 1 else 1
    return (error / scale).square().sum() / (components * total)


def soft_histogram(comm: Comm, values: Tensor, bins: int, reach: float) -> Tensor:
    """Histogram (bins,) over [-reach, reach] of the values of all ranks, with sum 1; collective, differentiable.

    `values` may have any shape. Each value is shared linearly between the two nearest bin centres. Values beyond an end
    count in the bin there. The histogram is NaN if a value is NaN.
    """
    position = (values.flatten().clamp(-reach, reach) + reach) * ((bins - 1) / (2 * reach))
    lower = position.detach().nan_to_num().floor().clamp(max=bins - 2).long()
    fraction = position - lower
    counts = torch.zeros(bins, dtype=values.dtype, device=values.device)
    counts = counts.index_add(0, lower, 1 - fraction).index_add(0, lower + 1, fraction)
    counts = sum_over_ranks(comm, counts)
    return counts / counts.sum()


def kullback_leibler(truth: Tensor, predicted: Tensor, floor: float = 1e-6) -> Tensor:
    """Divergence sum_k P log(P / Q) of two histograms (bins,), Eq. 14, with P the truth and Q the prediction.

    `floor` is first added to every bin. The sum of each histogram is then scaled to 1.
    """
    truth, predicted = (truth + floor) / (truth + floor).sum(), (predicted + floor) / (predicted + floor).sum()
    return (truth * torch.log(truth / predicted)).sum()
