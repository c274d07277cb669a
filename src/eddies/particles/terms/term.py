"""Base classes of the terms of the particle equations."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor, nn

from eddies.particles.context import Context, PairSum
from eddies.particles.flow_units import FlowUnits
from eddies.particles.rates import Rates
from eddies.scene.terms import TermBase, TermError, TermSettings


@dataclass(frozen=True)
class Coefficient:
    """A learned coefficient of a term, for reports.

    `name` is its symbol, `learned` the dimensionless parameter or parameters, and `meaning` their effect in words.
    `value` is `learned` in `unit`, for the flow of the term. A unit is a product of powers of L, T and M
    (eddies.io.units); "1" means a pure number.
    """

    name: str
    learned: float | list[float]
    value: float | list[float]
    unit: str
    meaning: str

    @classmethod
    def of(cls, name: str, learned: Tensor, meaning: str, unit: str = "1", scale: float = 1.0) -> Coefficient:
        """Make the coefficient of the parameter `learned`. Its value in `unit` is `scale` times the parameter."""
        exact = learned.detach().double()
        return cls(name, exact.tolist(), (exact * scale).tolist(), unit, meaning)


class Term(nn.Module, TermBase):
    """One term of dv_i/dt or d rho_i/dt: a module with named parameters, made from its settings for a flow.

    A user's term derives from this class, declares in its class `Settings` what it reads and gives, and computes its
    contribution in `forward`, in the units of `context.flow`. All ranks evaluate a term together, also ranks without
    particles. A term is `linear` if the rates at given particles are a linear function of the parameters plus a
    constant. Training then stores the effect of each parameter at each moment, instead of computing it at every
    training step.
    """

    Settings: type[TermSettings] = TermSettings
    linear = False

    def __init__(self, settings: TermSettings, flow: FlowUnits) -> None:
        super().__init__()
        self.settings, self.flow = settings, flow

    @property
    def learned_coefficients(self) -> list[Coefficient]:
        """Learned coefficients of the term; by default a single one, the number of its parameters."""
        count = sum(parameter.numel() for parameter in self.parameters())
        return [Coefficient("weights", count, count, "1", "number of weights")] if count else []

    def forward(self, context: Context) -> Rates:
        """Return the contribution of the term to the rates of all owned particles; may be collective."""
        raise TermError(f"{type(self).__name__}: has no forward(context); define it, and let it return Rates")


class PairTerm(Term, PairSum):
    """A term that is a sum over pairs; see PairSum.

    One pass over the pairs computes the sums of several such terms. There are two passes if some terms give a density
    that other terms read. Rates are computed for the requested particles only; in training these are some of the owned
    particles.
    """

    def rates_of(self, sums: Tensor, context: Context) -> Rates:
        """Return the contribution to the rates of k particles, from the sums (components, k) over their neighbours."""
        raise TermError(f"{type(self).__name__}: has no rates_of(sums, context); define it, and let it return Rates")

    def forward(self, context: Context) -> Rates:
        return self.rates_of(context.pair_sums(self), context)
