"""The eddy viscosity between two particles: the term Pi of Eq. 3."""

from __future__ import annotations

import torch
from torch import Tensor, nn

# Softens the approach speed at small distances, in squared units of the reference length.
SOFTENING = 0.1


class EddyViscosity(nn.Module):
    """Pi = -|a_1| mu + |a_2| mu^2 with mu = x.v / (|x|^2 + 0.1), in the model's dimensionless units.

    Parameters
    ----------
    form : "two-sided", acting on all pairs; or "monaghan", on approaching pairs only (mu < 0), as in SPH.

    Pi multiplies x_ij = x_i - x_j, so a positive Pi pushes apart. The two-sided form's mu^2 part also pushes
    apart receding pairs. Both coefficients are learned.
    """

    FORMS = ("two-sided", "monaghan")

    def __init__(self, form: str) -> None:
        super().__init__()
        self.approaching_only = form == "monaghan"
        self.coefficients = nn.Parameter(torch.full((2,), 0.1, dtype=torch.float64))

    def forward(self, distance: Tensor, approach: Tensor) -> Tensor:
        """Pi (m,) from |x| (m,) and x.v (m,)."""
        mu = approach / (distance * distance + SOFTENING)
        if self.approaching_only:
            mu = torch.clamp(mu, max=0)
        linear, quadratic = self.coefficients.abs()
        return mu * (quadratic * mu - linear)
