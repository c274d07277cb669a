"""Gradient descent by ranks that each differentiate their share of one global loss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from eddies.parallel.reduction import global_sum, sum_flat

MOMENTS = ("exp_avg", "exp_avg_sq")


class Descent:
    """Adam (Kingma and Ba 2014) with a learning rate that falls geometrically over `steps` steps.

    The loss given to `step` is this rank's share: the shares of all ranks add up to the global loss. Gradients are
    summed over ranks in one message, so all ranks, also those without particles, take the same step.
    """

    def __init__(self, comm, parameters: Iterable[nn.Parameter], steps: int, first_rate: float,
                 last_rate: float) -> None:
        self.comm, self.parameters = comm, list(parameters)
        self.steps, self.first_rate, self.last_rate = steps, first_rate, last_rate
        self.taken = 0
        self._adam = torch.optim.Adam(self.parameters, lr=first_rate)

    @property
    def learning_rate(self) -> float:
        """Rate of the next step."""
        return self.first_rate * (self.last_rate / self.first_rate) ** (self.taken / max(self.steps - 1, 1))

    def step(self, share: Tensor) -> float:
        """One step down the gradient of the sum of all shares; returns the norm of that gradient."""
        self._adam.zero_grad(set_to_none=False)
        if share.requires_grad:  # not where all that is left to learn shows through several steps alone
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
        for group in self._adam.param_groups:
            group["lr"] = self.learning_rate
        self._adam.step()
        self.taken += 1
        return norm

    def memory(self) -> dict[str, np.ndarray]:
        """What `restore` needs besides the parameters: Adam's running means, by name; the same on all ranks."""
        if self.taken == 0:
            return {}
        states = [self._adam.state[parameter] for parameter in self.parameters]
        return {f"{moment}_{number}": state[moment].cpu().numpy() for number, state in enumerate(states)
                for moment in MOMENTS}

    def restore(self, taken: int, memory: Mapping[str, np.ndarray]) -> None:
        """Go on after `taken` steps, with the parameters and the memory of then."""
        self.taken = taken
        for number, parameter in enumerate(self.parameters) if taken else ():
            moments = {moment: torch.from_numpy(memory[f"{moment}_{number}"]).to(parameter).reshape(parameter.shape)
                       for moment in MOMENTS}
            self._adam.state[parameter] = {"step": torch.tensor(float(taken)), **moments}


def shared_values(comm, shares: Mapping[str, Tensor]) -> dict[str, float]:
    """The global losses by name: sums of the shares of all ranks, in one message."""
    own = torch.stack([share.detach().double() for share in shares.values()])
    return dict(zip(shares, global_sum(comm, own.cpu().numpy()).tolist()))
