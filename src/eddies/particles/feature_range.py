"""Which inputs a network has seen, and how many of those that it is given lie outside of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from eddies.parallel.reduction import global_max, global_min, global_sum
from eddies.particles.dense_network import DenseNetwork

Result = TypeVar("Result")


@dataclass(frozen=True)
class FeatureRange:
    """Smallest and largest value of each input of a network over all pairs that it was trained on, (features,) each.

    Beyond them tanh layers go on smoothly, but what they give was never compared with anything.
    """

    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, comm, network: DenseNetwork, evaluate: Callable[[], object]) -> FeatureRange:
        """The range of what the network is given while `evaluate` runs, on all ranks; collective."""
        features = network.weights[0].shape[1]
        low, high = np.full(features, np.inf), np.full(features, -np.inf)

        def widen(values: Tensor) -> None:
            if values.shape[1] > 0:
                np.minimum(low, values.amin(1).double().cpu().numpy(), out=low)
                np.maximum(high, values.amax(1).double().cpu().numpy(), out=high)

        with _watched(network, widen):
            evaluate()
        return cls(global_min(comm, low), global_max(comm, high))

    def share_outside(self, comm, network: DenseNetwork, evaluate: Callable[[], Result]) -> tuple[Result, float]:
        """What `evaluate` returns, and the share of the pairs that the network is given meanwhile, on all ranks, of
        which some input lies outside the range, or is not a number; collective. Zero without pairs."""
        counts = np.zeros(2)

        def count(values: Tensor) -> None:
            low, high = (torch.from_numpy(bound).to(values).unsqueeze(1) for bound in (self.low, self.high))
            inside = ((values >= low) & (values <= high)).all(0)
            counts[:] += len(inside) - int(inside.sum()), len(inside)

        with _watched(network, count):
            result = evaluate()
        outside, total = global_sum(comm, counts)
        return result, float(outside / max(total, 1.0))


@contextmanager
def _watched(network: DenseNetwork, observe: Callable[[Tensor], None]) -> Iterator[None]:
    """Show all inputs (features, m) of the network to `observe`; afterwards nothing is left that costs time."""
    handle = network.register_forward_pre_hook(lambda module, inputs: observe(inputs[0].detach()))
    try:
        yield
    finally:
        handle.remove()
