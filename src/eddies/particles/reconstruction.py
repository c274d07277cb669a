"""Fields and their gradients from particles: kernel averages (Eqs. 5 and 6), normalised."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.particles.pairs import Pairs
from eddies.particles.smoothing_kernels import SmoothingKernel


def volumes(kernel: SmoothingKernel, pairs: Pairs) -> Tensor:
    """Volume of each particle, 1 / (W(0) + sum_j W(x_i - x_j)), shape (count,), in length^3.

    `pairs` leaves out the particle itself, which the first term counts once.
    """
    at_centre = kernel.value(pairs.distance.new_zeros(1))
    return 1 / (at_centre + pairs.sum(kernel.value(pairs.distance)))


def reconstruct(
    kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor
) -> Tensor:
    """<A>(x) = sum_j V_j A_j W(x - x_j) / sum_j V_j W(x - x_j) at the receivers: (count, components).

    Parameters
    ----------
    kernel : smoothing kernel whose support does not exceed the cutoff of the pairs.
    pairs : receivers are the points x. To evaluate at the particles themselves, the pairs must include each
        particle with itself.
    sender_volumes : (s,), volumes of all local particles, as `volumes` gives them.
    sender_values : (s, components), the quantity A at all local particles.

    A constant is reproduced to rounding. Zero where no particle lies within the support.
    """
    weight = pairs.at_senders(sender_volumes) * kernel.value(pairs.distance)
    weighted = weight * pairs.at_senders(sender_values).T
    sums = pairs.sum(torch.cat([weight.unsqueeze(0), weighted]).T)
    return sums[:, 1:] * _reciprocal(sums[:, :1])


def reconstruct_gradient(
    kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor
) -> Tensor:
    """Gradient of `reconstruct`: (count, components, 3), the last axis the direction of the derivative.

    It is sum_j V_j (A_j - <A>) grad W(x - x_j) / sum_j V_j W, the asymmetric finite-particle form, and
    exactly the derivative of the reconstructed field. Arguments as there.
    """
    return reconstruct_with_gradient(kernel, pairs, sender_volumes, sender_values)[1]


def reconstruct_with_gradient(
    kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor
) -> tuple[Tensor, Tensor]:
    """`reconstruct` and `reconstruct_gradient` at the cost of the second."""
    values = reconstruct(kernel, pairs, sender_volumes, sender_values)
    volume, distance = pairs.at_senders(sender_volumes), pairs.distance
    # Both the slope and the direction vanish with the distance.
    apart = torch.where(distance > 0, distance, torch.ones_like(distance))
    gradient = (volume * kernel.derivative(distance) / apart) * pairs.displacement.T
    deviation = pairs.at_senders(sender_values).T - values.T.contiguous().index_select(1, pairs.segment)
    products = deviation.unsqueeze(1) * gradient.unsqueeze(0)
    sums = pairs.sum(products.flatten(0, 1).T).reshape(pairs.count, *products.shape[:2])
    total = pairs.sum(volume * kernel.value(distance))
    return values, sums * _reciprocal(total)[:, None, None]


def _reciprocal(denominator: Tensor) -> Tensor:
    """1 / denominator, and zero where no particle contributes."""
    empty = denominator == 0
    return torch.where(empty, torch.zeros_like(denominator), 1 / torch.where(empty, 1, denominator))
