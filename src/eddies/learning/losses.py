"""Parts of the losses of Eqs. 12 to 15: a rank's share of a mean square, histograms, and their divergence."""

import torch
from torch import Tensor

from eddies.parallel.communicator import Comm
from eddies.particles.exchanges import sum_over_ranks


def mean_square_share(error: Tensor, scale: float, total: int) -> Tensor:
    """Return this rank's share of the mean of (error / scale)^2. The shares of all ranks add up to this mean.

    The mean is over the rows of all ranks, `total` in number, and over their components. `error` (n, c) or (n,) holds
    the rows of this rank. The mean is Eq. 12 with each component in units of `scale`.
    """
    components = error.shape[1] if error.dim() > 1 else 1
    return (error / scale).square().sum() / (components * total)


def soft_histogram(comm: Comm, values: Tensor, bins: int, reach: float) -> Tensor:
    """Return a histogram (bins,) of the values of all ranks, with sum 1; collective, differentiable.

    `values` may have any shape. The centres of the bins are equally spaced from -reach to reach. Each value is shared
    linearly between the two nearest centres. Values beyond -reach or reach count in the first or the last bin. The
    histogram is NaN if a value is NaN.
    """
    position = (values.flatten().clamp(-reach, reach) + reach) * ((bins - 1) / (2 * reach))
    lower = position.detach().nan_to_num().floor().clamp(max=bins - 2).long()
    fraction = position - lower
    counts = torch.zeros(bins, dtype=values.dtype, device=values.device)
    counts = counts.index_add(0, lower, 1 - fraction).index_add(0, lower + 1, fraction)
    counts = sum_over_ranks(comm, counts)
    return counts / counts.sum()


def kullback_leibler(truth: Tensor, predicted: Tensor, floor: float = 1e-6) -> Tensor:
    """Return the divergence sum_k P_k log(P_k / Q_k) of two histograms (bins,), Eq. 14: P is `truth`, Q `predicted`.

    First `floor` is added to every bin, and each histogram is scaled so that its sum is 1.
    """
    truth, predicted = (truth + floor) / (truth + floor).sum(), (predicted + floor) / (predicted + floor).sum()
    return (truth * torch.log(truth / predicted)).sum()
