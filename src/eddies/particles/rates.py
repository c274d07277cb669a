"""Contributions of terms to the rates of change of the particles."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields, replace

from torch import Tensor

# The rates with one row for each requested particle.
BY_PARTICLE = ("acceleration", "density_rate", "shift_velocity", "shift_acceleration")


@dataclass(frozen=True)
class Rates:
    """Contributions of a term to the rates of change of the n owned particles. Those that it does not give are None.

    Parameters
    ----------
    acceleration : (n, 3), acceleration of the fluid at the particles.
    density_rate : (n,), rate of change of the density.
    density : (n,), part of rho - rho_0, with the mean density rho_0, from a term that gives the density, not its rate.
    force_modes : Fourier modes (3, kz, ky, kx) of an acceleration on the grid of the resolved velocity.
    pressure_modes : Fourier modes (kz, ky, kx) of p / rho_0 for a pressure p. p / c^2 is added to the density;
        c is the speed of sound.
    shift_velocity : (n, 3), velocity of the particles relative to the fluid, dx/dt = v + shift_velocity.
    shift_acceleration : (n, 3), rate of change of the fluid velocity v at a particle due to the shift.

    The contributions of all terms are added. Modes are added before they are interpolated to the particles.
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
        """dv/dt (n, 3) of the particles: the acceleration of the fluid plus the shift acceleration."""
        assert self.acceleration is not None
        return self.acceleration if self.shift_acceleration is None else self.acceleration + self.shift_acceleration

    def at(self, rows: Tensor | None) -> Rates:
        """Return the rates of the particles `rows` (k,), or of all if it is None. `density` keeps the rows of all."""
        if rows is None:
            return self
        kept = {name: getattr(self, name)[rows] for name in BY_PARTICLE if getattr(self, name) is not None}
        return replace(self, **kept)


def described(value: object) -> str:
    """Describe a value that a user's code returns: a tensor by its shape and type, any other value by its class."""
    if isinstance(value, Tensor):
        return f"a tensor of shape {tuple(value.shape)} and type {str(value.dtype).removeprefix('torch.')}"
    return f"a {type(value).__name__}"


def total(contributions: Iterable[Rates]) -> Rates:
    """Return the sum of the contributions of several terms; a rate that none of them has is None."""
    sums: dict[str, Tensor] = {}
    for each in contributions:
        for field in fields(Rates):
            value = getattr(each, field.name)
            if value is not None:
                sums[field.name] = sums[field.name] + value if field.name in sums else value
    return Rates(**sums)
