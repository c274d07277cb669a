"""Lists of terms that go by a name, each with the settings that make it what it is."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

#: Where the words of a scene's [model] terms lead: class of the term, and class of its settings.
TERMS = {
    word: (f"eddies.particles.terms.{module}:{name}", f"eddies.particles.terms.settings:{name}")
    for word, module, name in (
        ("pairs", "pair_network", "PairNetwork"),
        ("eddy-viscosity", "eddy_viscosity", "EddyViscosity"),
        ("density-flux", "density_flux", "DensityFlux"),
        ("pressure", "pressure", "Pressure"),
        ("stress", "stress", "Stress"),
        ("viscosity", "viscosity", "Viscosity"),
        ("damping", "damping", "Damping"),
        ("relaxation", "relaxation", "Relaxation"),
        ("continuity", "continuity", "Continuity"),
        ("wcsph", "wcsph", "WCSPH"),
        ("transport-velocity", "transport_velocity", "TransportVelocity"),
        ("filtered-equations", "filtered_equations", "FilteredEquations"),
    )
}

# Near what training finds; the method's own values are tens of times the accelerations of turbulence.
LITTLE_FRICTION = {"alpha": 0.05, "beta": 1.5}

RESOLVED = ("pressure", "stress", "viscosity", "damping", "relaxation")

#: Of each preset the settings that differ from the terms' own, by term, in the order of the terms.
PRESETS: dict[str, dict[str, Mapping[str, Any]]] = {
    "resolved": dict.fromkeys(RESOLVED, {}),
    # The density there is that of the pressure, whose force is given: a network that is told of it learns no more, and
    # costs twice as much, as pairs then are not opposite.
    "resolved + pairs": {**dict.fromkeys(RESOLVED, {}), "pairs": {"inputs": ("distance", "speed", "approach")}},
    "paper": {"pairs": {"basis": "paper", "hidden": (20, 100, 20)}, "density-flux": {"hidden": (20, 100, 20)}},
    "local": {"filtered-equations": {}, "eddy-viscosity": {}},
    "wcsph": {"continuity": {}, "wcsph": LITTLE_FRICTION},
    "transport-velocity": {"continuity": {}, "wcsph": LITTLE_FRICTION, "transport-velocity": {}},
}
DEFAULT_PRESET = "resolved"
