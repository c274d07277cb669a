"""Gradient descent by ranks that each differentiate their share of one global loss."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from eddies.parallel.reduction import global_sum, sum_flat


class Descent:
    """Adam (Kingma and Ba 2014) with a learning rate that falls geometrically over `steps` steps.

    The loss given to `step` is this rank's share: the shares of all ranks add up to the global loss. Gradients are
    summed over ranks in one message, so all ranks, also those without particles, take the same step.
    """

    def __init__(self, comm, parameters: Iterable[nn.Parameter], steps: int, first_rate: float,
                 last_rate: float) -> None:
        self.comm, self.parameters = comm, list(parameters)
        self._adam = torch.optim.Adam(self.parameters, lr=first_rate)
        decay = (last_rate / first_rate) ** (1 / max(steps - 1, 1))
        self._schedule = torch.optim.lr_scheduler.ExponentialLR(self._adam, decay)

    @property
    def learning_rate(self) -> float:
        """Rate of the next step."""
        return self._adam.param_groups[0]["lr"]

    def step(self, share: Tensor) -> float:
        """One step down the gradient of the sum of all shares; returns the norm of that gradient."""
        self._adam.zero_grad(set_to_none=False)
        share.backward()
        # A rank whose share does not depend on a parameter still takes part in the sum.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
        for parameter, gradient in zip(self.parameters, gradients):
            parameter.grad = gradient
        on_host = [gradient.cpu() for gradient in gradients]
        sum_flat(self.comm, [gradient.numpy() for gradient in on_host])
        for gradient, summed in zip(gradients, on_host):
            gradient.copy_(summed)
        norm = float(sum(gradient.double().square().sum() for gradient in on_host) ** 0.5)
        self._adam.step()
        self._schedule.step()
        return norm


def shared_value(comm, share: Tensor) -> float:
    """The global loss: the sum of the shares of all ranks."""
    return float(global_sum(comm, share.detach().double().cpu().numpy()))
