"""A term of one's own that sums over pairs and has a network: a drag whose rate depends on the local strain.

    python docs/examples/own_drag.py                # or: mpirun -n 2 python docs/examples/own_drag.py

runs the scene `tiny` with it beside the terms of the preset `resolved`. A scene names it by its import path:

    [model]
    terms = ["pressure", "stress", "viscosity", "damping", "relaxation", "own_drag:StrainDrag"]

    [model.StrainDrag]
    rate = 0.1
"""

import math
from dataclasses import dataclass

import torch

import eddies


@dataclass(frozen=True, kw_only=True)
class Settings(eddies.TermSettings):
    """The keys of [model.StrainDrag], and what the term reads and gives."""

    rate: float = eddies.number("rate before training, in units of 2 u'/d", default=0.1, at_least=1e-3)

    reads = ("pairs",)
    gives = ("acceleration",)


class StrainDrag(eddies.PairTerm):
    """dv_i/dt = -(2 u'/d) g(|S| d/u') (v_i - <v>_i): <v>_i the mean over the neighbours with the weight w, u' the rms
    velocity, d the filter width, |S| = (2 S:S)^(1/2) the strain rate at the particle, and g a network."""

    Settings = Settings

    def __init__(self, settings: Settings, flow) -> None:
        super().__init__(settings, flow)
        with torch.random.fork_rng():  # equal weights on all ranks, whatever else draws random numbers
            torch.manual_seed(flow.seed)
            self.network = torch.nn.Sequential(torch.nn.Linear(1, 8), torch.nn.Tanh(), torch.nn.Linear(8, 1))
        self.network.double()
        torch.nn.init.constant_(self.network[-1].bias, math.log(math.expm1(settings.rate)))  # softplus gives `rate`

    def pair_values(self, pairs) -> torch.Tensor:
        """w and w (v_i - v_j)/u' of each pair, (4, m)."""
        return torch.cat([pairs.weight[None], pairs.weight * pairs.v])

    def rates_of(self, sums: torch.Tensor, context) -> eddies.Rates:
        """The drag from the sums (4, k) over the neighbours."""
        scales = context.flow.scales
        frequency = scales.velocity / scales.filter_width
        slip = sums[1:].T / sums[0, :, None].clamp_min(1e-6)                                 # (k, 3)
        _, slopes, _ = context.kriging.derivatives(context.particles.velocity)               # (n, 3, 3)
        strain = (slopes + slopes.transpose(1, 2)) / 2
        magnitude = (2 * strain.square().sum((1, 2))).clamp_min(1e-12).sqrt() / frequency    # (n,)
        if context.rows is not None:
            magnitude = magnitude[context.rows]
        inputs = magnitude[:, None].to(self.network[0].weight)
        rate = torch.nn.functional.softplus(self.network(inputs)).to(slip)                   # (k, 1)
        return eddies.Rates(acceleration=-2 * frequency * scales.velocity * rate * slip)


if __name__ == "__main__":
    terms = '["pressure", "stress", "viscosity", "damping", "relaxation", "own_drag:StrainDrag"]'
    eddies.run(eddies.load_scene("tiny", ['name="own-drag"', f"model.terms={terms}"], removals=["variant"]))
