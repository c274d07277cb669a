"""What a term contributes to the rates of change of the particles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields

from torch import Tensor


@dataclass(frozen=True)
class Rates:
    """Contributions of a term, each optional; contributions of terms add up.

    Parameters
    ----------
    acceleration : (n, 3) of the owned particles.
    density_rate : (n,), the rate of change of their density.
    density : (n,), a part of their density's deviation from the mean, where it is given and not integrated.
    force_modes : Fourier modes (3, kz, ky, kx) of an acceleration as a field on the grid of the resolved velocity.
    pressure_modes : (kz, ky, kx), those of a pressure p over the mean density, which adds p / c^2 to the density.

    What terms give as modes is added up and taken to the particles once.
    """

    acceleration: Tensor | None = None
    density_rate: Tensor | None = None
    density: Tensor | None = None
    force_modes: Tensor | None = None
    pressure_modes: Tensor | None = None

    def at(self, rows: Tensor | None) -> Rates:
        """The same with acceleration and rate of density of some rows (k,) of the particles alone."""
        if rows is None:
            return self
        kept = {name: None if getattr(self, name) is None else getattr(self, name)[rows]
                for name in ("acceleration", "density_rate")}
        return Rates(**kept, density=self.density, force_modes=self.force_modes, pressure_modes=self.pressure_modes)


def total(contributions: Iterable[Rates]) -> Rates:
    """The sum of contributions; what none of them gives is None."""
    sums: dict[str, Tensor] = {}
    for each in contributions:
        for field in fields(Rates):
            value = getattr(each, field.name)
            if value is not None:
                sums[field.name] = sums[field.name] + value if field.name in sums else value
    return Rates(**sums)
