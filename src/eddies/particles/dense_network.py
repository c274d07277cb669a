"""A small fully connected network with tanh layers, for many points at once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class DenseNetwork(nn.Module):
    """Fully connected tanh layers and a linear output layer; Glorot-normal weights, zero biases at first.

    Parameters
    ----------
    inputs, outputs : number of features and of outputs.
    hidden : widths of the hidden layers, at least one.
    seed : of the initial weights, which are drawn in double precision; convert the module for another.

    Points stand along the last axis, features along the first: then a layer is one matrix product, and each
    feature and output is a contiguous array.
    """

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, seed: int) -> None:
        super().__init__()
        if not hidden or min(hidden) < 1:
            raise ValueError(f"hidden layers {list(hidden)}: layers of at least one node are needed")
        generator = torch.Generator().manual_seed(seed)
        widths = [inputs, *hidden, outputs]
        shapes = list(zip(widths[1:], widths[:-1]))
        weights = [torch.empty(shape, dtype=torch.float64) for shape in shapes]
        for weight in weights:
            nn.init.xavier_normal_(weight, generator=generator)
        self.weights = nn.ParameterList(weights)
        self.biases = nn.ParameterList([torch.zeros(rows, 1, dtype=torch.float64) for rows, _ in shapes])

    def forward(self, features: Tensor) -> Tensor:
        """Outputs (outputs, m) of features (inputs, m).

        tanh(z) = 2 sigmoid(2 z) - 1, with the factors moved into the small weight matrices: the sigmoid is
        several times faster than tanh on a CPU.
        """
        values = torch.sigmoid(torch.addmm(2 * self.biases[0], 2 * self.weights[0], features))
        for layer in range(1, len(self.weights)):
            weight = self.weights[layer]
            bias = self.biases[layer] - weight.sum(1, keepdim=True)
            if layer == len(self.weights) - 1:
                return torch.addmm(bias, 2 * weight, values)
            values = torch.sigmoid(torch.addmm(2 * bias, 4 * weight, values))
        raise AssertionError("unreachable: there is an output layer")

    def with_tangent(self, features: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (outputs, m), and their derivative along `tangent` (inputs, m), both differentiable."""
        values, slopes = features, tangent
        for weight, bias in zip(self.weights[:-1], self.biases[:-1]):
            values, slopes = torch.tanh(torch.addmm(bias, weight, values)), weight @ slopes
            slopes = (1 - values * values) * slopes
        return torch.addmm(self.biases[-1], self.weights[-1], values), self.weights[-1] @ slopes
