"""Gradient descent on a global loss. Each rank differentiates its own share of the loss."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.adam import adam  # not the class Adam, which loads torch's compiler and takes two seconds

from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum, sum_flat


class Adam:
    """The optimiser Adam (Kingma and Ba 2014). The learning rate falls geometrically over `steps` steps.

    It falls from `first_rate` to `last_rate`. The global loss is the sum of the shares of all ranks. Gradients are
    summed over ranks in one message, so that all ranks, also those without particles, take the same step.
    """

    def __init__(self, comm: Comm, parameters: Iterable[nn.Parameter], steps: int, first_rate: float,
                 last_rate: float) -> None:
        self.comm, self.parameters = comm, list(parameters)
        self.steps, self.first_rate, self.last_rate = steps, first_rate, last_rate
        self.taken = 0
        # Running means of the gradient and of its square.
        self._moments = {name: [torch.zeros_like(p) for p in self.parameters]
                         for name in ("exp_avg", "exp_avg_sq")}

    @property
    def learning_rate(self) -> float:
        """Learning rate of the next step."""
        return self.first_rate * (self.last_rate / self.first_rate) ** (self.taken / max(self.steps - 1, 1))

    def step(self, share: Tensor) -> float:
        """Take a step, given this rank's share of the global loss, and return the norm of the global gradient."""
        for parameter in self.parameters:
            parameter.grad = None
        if share.requires_grad:  # otherwise no parameter affects this rank's share
            share.backward()
        # A rank whose share does not depend on a parameter still takes part in the sum.
        gradients = [torch.zeros_like(p) if p.grad is None else p.grad for p in self.parameters]
        on_host = [gradient.cpu() for gradient in gradients]
        sum_flat(self.comm, [gradient.numpy() for gradient in on_host])
        for gradient, summed in zip(gradients, on_host):
            gradient.copy_(summed)
        norm = float(sum(gradient.double().square().sum() for gradient in on_host) ** 0.5)
        steps = [torch.tensor(float(self.taken)) for _ in self.parameters]  # `adam` adds 1 to each
        with torch.no_grad():
            adam(self.parameters, gradients, *self._moments.values(), [], steps, amsgrad=False, beta1=0.9,
                 beta2=0.999, lr=self.learning_rate, weight_decay=0.0, eps=1e-8, maximize=False)
        self.taken += 1
        return norm

    def state_dict(self) -> dict[str, int | np.ndarray]:
        """Return the number of steps taken and the running means, for a checkpoint; they are equal on all ranks."""
        means = {f"{name}_{number}": mean.cpu().numpy() for name, means in self._moments.items()
                 for number, mean in enumerate(means)}
        return {"taken": self.taken, **means}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `state_dict`."""
        self.taken = state["taken"]
        for name, means in self._moments.items():
            for number, mean in enumerate(means):
                mean.copy_(torch.from_numpy(state[f"{name}_{number}"]).reshape(mean.shape))


def shared_values(comm: Comm, shares: Mapping[str, Tensor]) -> dict[str, float]:
    """Return, for each name, the sum of the shares of all ranks. One message carries all of them."""
    own = np.array([float(share.detach()) for share in shares.values()])  # shares may be on different devices
    return dict(zip(shares, global_sum(comm, own).tolist()))
