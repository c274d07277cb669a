"""What a term of the particle equations is."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from eddies.particles.context import Context
from eddies.particles.flow_units import FlowUnits
from eddies.particles.pairs import ScaledPairs
from eddies.particles.rates import Rates
from eddies.scene.terms import TermBase, TermSettings


@dataclass(frozen=True)
class Coefficient:
    """What a term has learned, for reports.

    Parameters
    ----------
    name : its symbol.
    learned : as it is learned, dimensionless: a number, or several.
    value : the same in `unit`, of the flow that the term is made for.
    unit : of L, T and M (eddies.io.quantities); "1" of a pure number.
    meaning : what it does, in words.
    """

    name: str
    learned: float | list[float]
    value: float | list[float]
    unit: str
    meaning: str

    @classmethod
    def of(cls, name: str, learned: Tensor, meaning: str, unit: str = "1", scale: float = 1.0) -> Coefficient:
        """That of a parameter, whose value 1 is `scale` of a unit."""
        exact = learned.detach().double()
        return cls(name, exact.tolist(), (exact * scale).tolist(), unit, meaning)


class Term(nn.Module, TermBase):
    """One term of dv_i/dt or d rho_i/dt: a module with named parameters, made for a flow with its settings.

    Rates are in the units of `context.flow`.

    A term of one's own subclasses it, declares what it reads and gives on its class of `Settings`, and computes its
    contribution in `forward`. All ranks evaluate a term together, also those without particles.

    Attributes
    ----------
    Settings : class of its settings, a frozen dataclass derived from TermSettings.
    linear : true where the rates at given particles are a linear function of the parameters plus a constant. Then
        training keeps what single parameters do at a moment instead of computing it at every step.
    """

    Settings: type[TermSettings] = TermSettings
    linear = False

    def __init__(self, settings: TermSettings, flow: FlowUnits) -> None:
        super().__init__()
        self.settings, self.flow = settings, flow

    @property
    def reads(self) -> Sequence[str]:
        """What it reads: see TermSettings."""
        return self.settings.reads

    @property
    def gives(self) -> Sequence[str]:
        """What it contributes to: see TermSettings."""
        return self.settings.gives

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """What it has learned; unless a term says more, how many numbers."""
        count = sum(parameter.numel() for parameter in self.parameters())
        return [Coefficient("weights", count, count, "1", "learned numbers")] if count else []

    def forward(self, context: Context) -> Rates:
        """The contribution to all owned particles; may be collective."""
        raise NotImplementedError(f"{type(self).__name__} has no forward(context)")


class PairTerm(Term):
    """A term that is a sum over neighbours within the radius of interaction, of `pair_values`.

    Sums of such terms are taken together, pairs being gathered once; or twice where terms give a density that others
    read. Its rates are those of the particles that are asked for, which in training are some of the owned ones.

    Attributes
    ----------
    width : most numbers that are held for a pair at once, for choosing how many pairs to take together.
    needs_moments : whether `rates_of` asks for `context.moments`.
    mutual : whether what j gets from i is what i gets from j times `parity`, so that a pair is evaluated once.
    parity : (components,), 1 or -1.
    """

    width = 8
    needs_moments = False
    mutual = False
    parity: Tensor = torch.ones(1)

    def pair_values(self, pairs: ScaledPairs) -> Tensor:
        """What is summed over neighbours, (components, m); zero beyond the radius of interaction: listed pairs may be
        farther apart."""
        raise NotImplementedError(f"{type(self).__name__} has no pair_values(pairs)")

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """The contribution from the sums (components, k) over each particle's neighbours."""
        raise NotImplementedError(f"{type(self).__name__} has no rates_of(sums, context)")

    def forward(self, context: Context) -> Rates:
        """The contribution to the particles that are asked for; collective."""
        return self.rates_of(context.pair_sums(self), context)
