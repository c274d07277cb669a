"""A term of one's own: Smagorinsky's model of the stress that the filter hides, in place of the deconvolved one.

    python docs/examples/own_term.py                # or: mpirun -n 2 python docs/examples/own_term.py

runs the scene `tiny` with it: ground truth, training of its coefficient, rollout, report. A scene names it by its
import path, in a TOML file beside this one or on the command line:

    [model]
    terms = ["pressure", "own_term:SmagorinskyStress", "viscosity", "relaxation", "pairs"]

    [model.SmagorinskyStress]
    constant = 0.1
"""

from dataclasses import dataclass

import torch

import eddies


@dataclass(frozen=True, kw_only=True)
class Settings(eddies.TermSettings):
    """What [model.SmagorinskyStress] may say, and what the term reads and gives."""

    constant: float = eddies.number("C of the eddy viscosity (C d)^2 |S|, before training", default=0.17, at_least=0)

    reads = ("resolved",)
    gives = ("acceleration", "density")


class SmagorinskyStress(eddies.Term):
    """-P[div tau] with  tau = -2 nu_t S,  nu_t = (C d)^2 |S|,  |S| = (2 S:S)^(1/2),  d the filter width; C^2 is
    learned."""

    Settings = Settings
    linear = True  # in its parameter, C^2

    def __init__(self, settings: Settings, flow) -> None:
        super().__init__(settings, flow)
        self.squared_constant = torch.nn.Parameter(torch.tensor(settings.constant**2, dtype=torch.float64))

    def forward(self, context) -> eddies.Rates:
        grid = context.resolved.grid
        slopes = grid.slopes(context.resolved.velocity)  # d_j u_i at the grid points
        strain = (slopes + slopes.transpose(0, 1)) / 2
        magnitude = (2 * strain.square().sum((0, 1))).clamp_min(1e-30).sqrt()  # whose slope at rest is none
        entries = torch.stack([strain[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))])
        factor = -2 * self.squared_constant.double().cpu() * context.flow.scales.filter_width**2
        return grid.hidden_stress(factor * grid.to_modes(magnitude * entries))


if __name__ == "__main__":
    terms = '["pressure", "own_term:SmagorinskyStress", "viscosity", "relaxation", "pairs"]'
    eddies.run(eddies.load_scene("tiny", ['name="own-term"', f"model.terms={terms}"], removals=["variant"]))
