"""Measured scales by which the pair-force model is made dimensionless."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, fields


@dataclass(frozen=True)
class ReferenceScales:
    """Scales of one flow, all measured on its filtered ground truth, in the units of the simulation.

    Parameters
    ----------
    length : filter width d, the unit of length in Eq. 4.
    spacing : mean distance of particles, (box volume / particles)^(1/3).
    velocity : rms of one velocity component.
    density_mean : mean density rho_0.
    density : rms of the density fluctuation rho - rho_0.
    acceleration : rms of one component of the acceleration along trajectories.
    density_rate : rms of the rate of change of density along trajectories.
    sound_speed : speed of sound c.

    A flow at another Mach number supplies its own scales to the same network. Raises ValueError unless all
    are finite and positive.
    """

    length: float
    spacing: float
    velocity: float
    density_mean: float
    density: float
    acceleration: float
    density_rate: float
    sound_speed: float

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not (math.isfinite(value) and value > 0):
                raise ValueError(f"reference scale {field.name} = {value}: must be finite and positive")

    def to_dict(self) -> dict[str, float]:
        """The scales by name, ready for JSON."""
        return {name: float(value) for name, value in asdict(self).items()}

    @classmethod
    def from_dict(cls, scales: dict[str, float]) -> ReferenceScales:
        """Inverse of `to_dict`; raises ValueError when a scale is missing or unknown."""
        expected = {field.name for field in fields(cls)}
        if set(scales) != expected:
            raise ValueError(f"reference scales {sorted(scales)}: expected {sorted(expected)}")
        return cls(**scales)
