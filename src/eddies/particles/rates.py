"""What a term contributes to the rates of change of the particles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

from torch import Tensor


BY_PARTICLE = ("acceleration", "density_rate", "shift_velocity", "shift_acceleration")


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
    shift_velocity : (n, 3), of particles that move beside the fluid, dx/dt = v + shift_velocity.
    shift_acceleration : (n, 3), what their velocity changes by for that: v is that of the fluid where they are. It adds
        to the acceleration, which is that of the fluid and is compared with the truth.

    What terms give as modes is added up and taken to the particles once.
    """

    acceleration: Tensor | None = None
    density_rate: Tensor | None = None
    density: Tensor | None = None
    force_modes: Tensor | None = None
    pressure_modes: Tensor | None = None
    shift_velocity: Tensor | None = None
    shift_acceleration: Tensor | None = None

    @property
    def velocity_rate(self) -> Tensor:
        """dv/dt (n, 3) of the particles, where an acceleration is given: that of the fluid, and what a shift adds."""
        assert self.acceleration is not None
        return self.acceleration if self.shift_acceleration is None else self.acceleration + self.shift_acceleration

    def at(self, rows: Tensor | None) -> Rates:
        """The same with what is of the particles, but the density, of some rows (k,) of them alone."""
        if rows is None:
            return self
        kept = {name: getattr(self, name)[rows] for name in BY_PARTICLE if getattr(self, name) is not None}
        return replace(self, **kept)


def total(contributions: Iterable[Rates]) -> Rates:
    """The sum of contributions; what none of them gives is None."""
    sums: dict[str, Tensor] = {}
    for each in contributions:
        for field in fields(Rates):
            value = getattr(each, field.name)
            if value is not None:
                sums[field.name] = sums[field.name] + value if field.name in sums else value
    return Rates(**sums)
