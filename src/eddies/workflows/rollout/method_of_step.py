"""What moves the particles of a rollout, made with the step that its scene gives or that was found for it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from eddies.import_path import is_path, load
from eddies.io.hdf5 import open_product, read_attributes
from eddies.parallel.communicator import Comm
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.scene.sections import CONVERGED
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.eulerian_run import EulerianRun
from eddies.workflows.rollout.method import Method
from eddies.workflows.rollout.particle_run import BallisticRun, LearnedRun, ParticleRun

#: The classes behind the words of [simulation] method, each built as Class(scene, truth, start, directory, device).
METHODS: dict[str, Callable[..., Method]] = {"learned": LearnedRun, "none": BallisticRun, "eulerian": EulerianRun}


@dataclass(frozen=True)
class Step:
    """How a rollout steps in time: its integrator and the longest step; on a grid "etdrk4" and the Courant number."""

    integrator: str
    size: float


def method_of_step(scene: Scene, step: Step | None, truth: GroundTruth, start: int, directory: Path,
                   device: torch.device) -> Method:
    """The method of a scene from a frame of the truth on, with a step in place of the scene's; collective.

    With such a step particles are not limited to what their resolved velocity is expected to follow.
    """
    settings = scene.simulation
    if step is not None and settings.on_grid:
        scene = replace(scene, time=replace(scene.time, courant=step.size))
    elif step is not None:
        given = replace(settings, integrator=step.integrator, step=step.size, step_from=None, confirmed_on=None)
        scene = replace(scene, simulation=given)
    kind = load(settings.method) if is_path(settings.method) else METHODS[settings.method]
    method = kind(scene, truth, start, directory, device)
    if step is not None and isinstance(method, ParticleRun):
        method.limited = False
    return method


def stored_step(scene: Scene, comm: Comm, directory: Path) -> Step | None:
    """The step that was found for the rollout of a run directory; None where the scene gives a number. Collective."""
    if scene.simulation.step != CONVERGED:
        return None
    with open_product(comm, scene.step_file or directory / STAGES["find-step"].file, "step") as file:
        found = read_attributes(file, "found")
    return Step(found["integrator"], found["size"])
