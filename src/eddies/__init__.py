"""Lagrangian large-eddy simulation of turbulence, learned from direct numerical simulation, on MPI."""

from importlib import import_module
from typing import Any

__version__ = "2.0.0"

# The public names, by the module that defines them. A module is imported when one of its names is first used, so that
# reading a scene starts neither MPI nor torch.
_HOMES = {
    "eddies.api": ("check", "run", "simulate", "train"),
    "eddies.stored_run": ("StoredRun", "open_run"),
    "eddies.io.track_files": ("read_tracks", "write_tracks"),
    "eddies.errors": ("UserError",),
    "eddies.import_path": ("ImportPathError",),
    "eddies.scene.scene": ("Scene", "SceneError", "load_scene", "Eulerian", "Flow", "Forcing", "Horizons", "Initial",
                           "Kernel", "Model", "Reconstruction", "Simulation", "SpinUp", "Time", "Tracers", "Tracks",
                           "Training"),
    "eddies.scene.values": ("boolean", "choice", "integer", "integers", "named", "number", "numbers", "text",
                            "texts"),
    "eddies.scene.terms": ("TermError", "TermSettings"),
    "eddies.particles.terms.term": ("PairTerm", "Term"),
    "eddies.particles.rates": ("Rates",),
    "eddies.particles.model": ("LagrangianModel", "build_model"),
    "eddies.particles.flow_units": ("FlowUnits", "ReferenceScales"),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}
__all__ = [*_HOME_OF]


def __getattr__(name: str) -> Any:
    if name not in _HOME_OF:
        raise AttributeError(f"module 'eddies' has no attribute '{name}'")
    value = globals()[name] = getattr(import_module(_HOME_OF[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_HOME_OF})
