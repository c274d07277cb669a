"""What a model is told of the flow that it is used on."""

from __future__ import annotations

from dataclasses import dataclass

from eddies.particles.reference_scales import ReferenceScales


@dataclass(frozen=True)
class FlowUnits:
    """The scales of a flow, by which terms are made dimensionless, and the neighbourhoods of its particles.

    Parameters
    ----------
    scales : measured where the flow starts.
    cutoff : h, the radius of interaction of pairs.
    neighbors : n, the expected number of particles within it.
    seed : of initial parameters.
    """

    scales: ReferenceScales
    cutoff: float
    neighbors: float
    seed: int = 1

    @property
    def particle_mass(self) -> float:
        """Mass of a particle: that of all fluid over the number of particles."""
        return self.scales.density_mean * self.scales.spacing**3
