"""Methods that move the particles of a rollout: the interface, the methods of the package, and their choice."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch

from eddies.import_path import is_path, load, users_code
from eddies.io.checkpoint import Checkpoint
from eddies.particles.particle_set import ParticleSet
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.rollout.eulerian_run import EulerianRun
from eddies.workflows.rollout.particle_run import ParticleRun


class Method(Protocol):
    """Moves the particles of a rollout. Class(scene, truth, start, directory, device) makes an instance, where `start`
    is the frame of the ground truth at which the rollout starts. All methods are collective.

    `state_dict` and `load_state_dict` may be missing: a stopped rollout then starts again from the beginning.
    """

    has_density: bool  # whether the particles of a frame have a density

    time: float  # time of the particles since the start of the rollout

    def advance(self, until: float, number: int) -> str | None:
        """Take one step, the `number`-th, towards the time `until`. The step may pass that time if `frame` can
        interpolate. Returns on all ranks a text on the fault of the new state, None for a sound state."""

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """The particles at a time within the last step, in any order, and their acceleration (n, 3)."""

    def status(self) -> str:
        """Text for the progress line, after time and energy."""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Tables for the product: values by table and column. Each column has one value for each call of `frame`."""

    def description(self) -> dict[str, float | str]:
        """Settings of the method, for the attributes of the product."""

    def state_dict(self) -> dict[str, Any]:
        """The present state by name, to be passed to `CheckpointDirectory.write`. No name begins with "rollout"."""

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Continue from a checkpoint, made on any number of ranks; exact on the same number of ranks."""


#: The class of each built-in [simulation] method.
METHODS: dict[str, Callable[..., Method]] = {"learned": ParticleRun, "none": ParticleRun, "eulerian": EulerianRun}


@dataclass(frozen=True)
class TimeStep:
    """Integrator and longest time step of a rollout. On a coarse grid they are "etdrk4" and the Courant number."""

    integrator: str
    size: float


def make_method(scene: Scene, step: TimeStep | None, truth: GroundTruth, start: int, directory: Path) -> Method:
    """Make the method of a scene for a rollout that starts at a frame of the truth; collective.

    A given `step` replaces the step of the scene. The resolved velocity then does not limit the step.
    """
    settings = scene.simulation
    if step is not None and settings.on_grid:
        scene = replace(scene, time=replace(scene.time, courant=step.size))
    elif step is not None:
        given = replace(settings, integrator=step.integrator, step=step.size, step_from=None, confirmed_on=None)
        scene = replace(scene, simulation=given)
    kind = load(settings.method) if is_path(settings.method) else METHODS[settings.method]
    hint = f'; [simulation] method = "{settings.method}" is called with (scene, truth, start, directory, device)'
    with users_code(kind, SceneError, hint):
        method = kind(scene, truth, start, directory, truth.device)
    if step is not None and isinstance(method, ParticleRun):
        method.limited = False
    return method
