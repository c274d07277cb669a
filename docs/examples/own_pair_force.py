"""A pair force of one's own: a network of invariants of a pair, in place of the pair force of the published system.

    python docs/examples/own_pair_force.py          # or: mpirun -n 2 python docs/examples/own_pair_force.py

runs the scene `tiny` with it. A scene names it by its import path:

    [model]
    terms = ["own_pair_force:PairForce", "eddy-viscosity", "density-flux", "density-diffusion"]

    [model.PairForce]
    width = 20
"""

from dataclasses import dataclass

import torch

import eddies


@dataclass(frozen=True, kw_only=True)
class Settings(eddies.TermSettings):
    """The keys of [model.PairForce], and what the term reads and gives."""

    width: int = eddies.integer("neurons of each of the two hidden layers", default=20, at_least=1)

    reads = ("pairs", "density")
    gives = ("acceleration",)


class PairForce(eddies.PairTerm):
    """dv_i/dt = (a_rms/n) sum_j w (f_x x + f_v v): x and v are the differences of position and velocity in filter
    widths and rms velocities, w the weight of the pair, n the mean number of neighbours, and f_x and f_v a network.

    The inputs of the network are |x|, |v|^2, x.v and the two densities, which rotations do not change.
    """

    Settings = Settings

    def __init__(self, settings: Settings, flow) -> None:
        super().__init__(settings, flow)
        width = settings.width
        with torch.random.fork_rng():  # equal weights on all ranks, whatever else draws random numbers
            torch.manual_seed(flow.seed)
            self.network = torch.nn.Sequential(
                torch.nn.Linear(5, width), torch.nn.Tanh(), torch.nn.Linear(width, width), torch.nn.Tanh(),
                torch.nn.Linear(width, 2))

    def pair_values(self, pairs) -> torch.Tensor:
        """w (f_x x + f_v v) of each pair, (3, m)."""
        inputs = torch.stack([pairs.distance, pairs.v.square().sum(0), pairs.approach, *pairs.densities])
        along_x, along_v = self.network(inputs.T.to(self.network[0].weight)).T.to(pairs.x)
        return pairs.weight * (along_x * pairs.x + along_v * pairs.v)

    def rates_of(self, sums: torch.Tensor, context) -> eddies.Rates:
        """The acceleration from the sums (3, k) over the neighbours."""
        flow = context.flow
        return eddies.Rates(acceleration=flow.scales.acceleration / flow.neighbors * sums.T)


if __name__ == "__main__":
    terms = '["own_pair_force:PairForce", "eddy-viscosity", "density-flux", "density-diffusion"]'
    eddies.run(eddies.load_scene("tiny", ['name="own-pair-force"', f"model.terms={terms}"], removals=["variant"]))
