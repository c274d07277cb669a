"""Kernel averages of a quantity that particles carry (Eqs. 5 and 6) and the gradients of these averages, by torch."""

from __future__ import annotations

import torch
from torch import Tensor

from eddies.particles.pairs import Pairs
from eddies.particles.smoothing_kernels import SmoothingKernel, over_distance


def volumes(kernel: SmoothingKernel, pairs: Pairs) -> Tensor:
    """Return the volume 1 / (W(0) + sum_j W(x_i - x_j)) of each particle i, (count,), or the kernel's mean volume.

    `pairs` must not pair a particle with itself: W(0) already counts the particle.
    """
    if kernel.mean_volume is not None:
        return pairs.distance.new_full((pairs.count,), kernel.mean_volume)
    at_centre = kernel.value(pairs.distance.new_zeros(1))
    return 1 / (at_centre + pairs.sum(kernel.value(pairs.distance)[None])[0])


def reconstruct(kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor, sender_values: Tensor) -> Tensor:
    """Return <A>(x) = sum_j V_j A_j W(x - x_j) / sum_j V_j W(x - x_j) at the receivers x, (count, components).

    A kernel with a mean volume gives the numerator alone, Eq. 6. The result is zero where no particle lies within the
    support. The volumes V (s,) and values A (s, components) are those of all local particles. A particle that is a
    receiver must be among its own neighbours.
    """
    return _average(kernel, pairs, pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T)[0].T


def reconstruct_with_gradient(kernel: SmoothingKernel, pairs: Pairs, sender_volumes: Tensor,
                              sender_values: Tensor) -> tuple[Tensor, Tensor]:
    """Return the result of `reconstruct`, and its gradient (count, components, 3) with the direction as the last axis.

    The gradient sum_j V_j (A_j - <A>) grad W(x - x_j) / sum_j V_j W is exactly the gradient of the average.
    """
    volume, value, distance = pairs.at_senders(sender_volumes), pairs.at_senders(sender_values).T, pairs.distance
    average, factor = _average(kernel, pairs, volume, value)
    gradient = volume * over_distance(kernel.derivative(distance), distance) * pairs.displacement.T
    products = (value - average.index_select(1, pairs.segment)).unsqueeze(1) * gradient
    sums = pairs.sum(products.flatten(0, 1)) * factor
    return average.T, sums.unflatten(0, products.shape[:2]).permute(2, 0, 1)


def normalisation(kernel: SmoothingKernel, denominator: Tensor) -> Tensor:
    """Return 1 / denominator, or zero where no particle contributes; 1 for a kernel with a mean volume."""
    if kernel.mean_volume is not None:
        return torch.ones_like(denominator)
    empty = denominator == 0
    return torch.where(empty, torch.zeros_like(denominator), 1 / torch.where(empty, 1, denominator))


def _average(kernel: SmoothingKernel, pairs: Pairs, volume: Tensor, value: Tensor) -> tuple[Tensor, Tensor]:
    """Return the average (components, count) and its `normalisation` (1, count).

    `volume` (m,) and `value` (components, m) are those of the sender of each pair.
    """
    weight = volume * kernel.value(pairs.distance)
    sums = pairs.sum(torch.cat([weight.unsqueeze(0), weight * value]))
    factor = normalisation(kernel, sums[:1])
    return sums[1:] * factor, factor
