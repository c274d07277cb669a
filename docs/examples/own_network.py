"""A network of one's own for the pair force: waves of the features instead of tanh layers.

    python docs/examples/own_network.py             # or: mpirun -n 2 python docs/examples/own_network.py

runs the scene `tiny` with it. A scene names it by its import path:

    [model.pairs]
    network = "own_network:Waves"
    hidden = [16]
"""

import torch

import eddies


class Waves(torch.nn.Module):
    """Sums of sines of random combinations of the features, their amplitudes, phases and wavevectors learned.

    Made with the number of features of a pair, the widths of [model.pairs] hidden, the number of outputs and a seed;
    takes features (inputs, m) of m pairs to outputs (outputs, m).
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], outputs: int, seed: int) -> None:
        super().__init__()
        random = torch.Generator().manual_seed(seed)
        waves = sum(hidden)
        self.wavevectors = torch.nn.Parameter(torch.randn(waves, inputs, generator=random, dtype=torch.float64))
        self.phases = torch.nn.Parameter(torch.zeros(waves, 1, dtype=torch.float64))
        self.amplitudes = torch.nn.Parameter(
            torch.randn(outputs, waves, generator=random, dtype=torch.float64) / waves**0.5)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        return self.amplitudes @ torch.sin(self.wavevectors @ features + self.phases)


if __name__ == "__main__":
    eddies.run(eddies.load_scene("tiny", ['name="own-network"', "model.pairs.network=own_network:Waves"],
                                 removals=["variant"]))
