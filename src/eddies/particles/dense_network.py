"""A small fully connected network with tanh layers, evaluated at many points at once."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn


class DenseNetwork(nn.Module):
    """Fully connected tanh layers and a linear output layer. Initial weights are Glorot-normal, initial biases zero.

    Features are along the first axis and points along the last: a layer is then one matrix product, and each feature
    and output is a contiguous array.

    Parameters
    ----------
    inputs, outputs : number of features and of outputs.
    hidden : widths of the hidden layers, at least one.
    seed : seed of the initial weights. They are drawn in double precision; convert the module for another precision.
    """

    def __init__(self, inputs: int, hidden: Sequence[int], outputs: int, seed: int) -> None:
        super().__init__()
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

        The tanh is computed as tanh(z) = 2 sigmoid(2 z) - 1, with the factors moved into the small weight matrices:
        the sigmoid is several times faster than tanh on a CPU.
        """
        values = torch.sigmoid(torch.addmm(2 * self.biases[0], 2 * self.weights[0], features))
        for weight, bias in zip(self.weights[1:-1], self.biases[1:-1]):
            values = torch.sigmoid(torch.addmm(2 * (bias - weight.sum(1, keepdim=True)), 4 * weight, values))
        weight, bias = self.weights[-1], self.biases[-1]
        return torch.addmm(bias - weight.sum(1, keepdim=True), 2 * weight, values)

    def with_tangent(self, features: Tensor, tangent: Tensor) -> tuple[Tensor, Tensor]:
        """Outputs (outputs, m) and their derivative along `tangent` (inputs, m), both differentiable."""
        values, slopes = features, tangent
        for weight, bias in zip(self.weights[:-1], self.biases[:-1]):
            values, slopes = torch.tanh(torch.addmm(bias, weight, values)), weight @ slopes
            slopes = (1 - values * values) * slopes
        return torch.addmm(self.biases[-1], self.weights[-1], values), self.weights[-1] @ slopes
