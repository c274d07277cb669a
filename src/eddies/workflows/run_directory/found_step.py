"""The step that short rollouts have found, for the rollout that takes it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.hdf5 import open_product, read_attributes, read_table
from eddies.parallel.communicator import Comm
from eddies.pipeline import STAGES
from eddies.scene.scene import Simulation
from eddies.scene.sections import CONVERGED


def step_path(settings: Simulation, directory: Path) -> Path | None:
    """The file of the step that a rollout takes: of its run directory or of [simulation] step_from; None if the step is
    a number."""
    if settings.step != CONVERGED:
        return None
    return Path(settings.step_from or directory) / STAGES["find-step"].file


def read_found_step(path: Path, comm: Comm) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The attributes of a found step, and the trials with its integrator; all ranks call it."""
    with open_product(comm, path, "step") as file:
        found = read_attributes(file, "found")
        return found, read_table(file, f"trials/{found['integrator']}")
