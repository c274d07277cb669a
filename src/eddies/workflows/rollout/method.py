"""The methods that move the particles of a rollout: their interface, and the choice of the method of a scene."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import torch

from eddies.import_path import is_path, load, users_code
from eddies.io.checkpoint import Checkpoint
from eddies.io.weights import load_weights
from eddies.particles.feature_range import FeatureRange
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_set import ParticleSet
from eddies.pipeline import STAGES
from eddies.scene.scene import Eulerian, Scene, SceneError
from eddies.scene.scene import Forcing as ForcingSection
from eddies.scene.terms import Forcing
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.model import trained_model
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.rollout.eulerian_run import EulerianRun, coarse_fluid
from eddies.workflows.rollout.particle_run import ParticleRun


class Method(Protocol):
    """Moves the particles of a rollout. All functions are collective.

    A user's class is called with (scene, truth, start, directory, device), where `start` is the frame of the ground
    truth at which the rollout starts. It may lack `state_dict` and `load_state_dict`. A stopped rollout then starts
    again from the beginning.
    """

    has_density: bool  # whether the particles of a frame have a density

    time: float  # time of the particles since the start of the rollout

    def advance(self, until: float, number: int) -> str | None:
        """Take the step with this `number` towards the time `until`.

        The step may pass that time if `frame` can interpolate. Returns a text that describes the fault of the new
        state, or None if there is no fault; the result is the same on all ranks.
        """

    def frame(self, time: float) -> tuple[ParticleSet, torch.Tensor]:
        """Return the particles at a time within the last step, in any order, and their acceleration (n, 3)."""

    def status(self) -> str:
        """Return the text that the progress line shows after the time and the energy."""

    def series(self) -> dict[str, dict[str, list[float]]]:
        """Return tables for the product: values by name of the table and of the column. Each column has one value for
        each call of `frame`."""

    def description(self) -> dict[str, float | str]:
        """Return the settings of the method, which become attributes of the product."""

    def state_dict(self) -> dict[str, Any]:
        """Return the present state by name, as `CheckpointDirectory.write` takes it. No name begins with "rollout"."""

    def load_state_dict(self, saved: Checkpoint) -> None:
        """Continue from a checkpoint that was made on any number of ranks. The continued run is exact on the same
        number."""


@dataclass(frozen=True)
class TimeStep:
    """Integrator and longest time step of a rollout. On a coarse grid they are "etdrk4" and the Courant number."""

    integrator: str
    size: float


def make_method(scene: Scene, step: TimeStep | None, truth: GroundTruth, start: int, directory: Path) -> Method:
    """Make the method of a scene for a rollout that starts at the frame `start` of the truth; collective.

    A given `step` replaces the step of the scene; the resolved velocity then does not limit the step. `directory` is
    the run directory.
    """
    settings, courant = scene.simulation, scene.time.courant
    if step is not None and settings.form.on_grid:
        courant = step.size
    elif step is not None:
        settings = replace(settings, integrator=step.integrator, step=step.size, step_from=None, confirmed_on=None)
    if is_path(settings.method):
        kind = load(settings.method)
        hint = f'; [simulation] method = "{settings.method}" is called with (scene, truth, start, directory, device)'
        with users_code(kind, SceneError, hint):
            return kind(replace(scene, simulation=settings), truth, start, directory, truth.device)
    comm, trained = truth.decomposition.comm, directory / STAGES["train"].file
    forcing = forcing_of(settings.injection, scene.forcing, truth)
    if settings.form.on_grid:
        eulerian, rates = scene.eulerian or Eulerian(), None
        if eulerian.form.learned:
            rates = load_weights(comm, trained, "model").weights[f"terms.{scene.model.damping}"]
        fluid = coarse_fluid(eulerian, scene.flow, settings.precision, forcing, truth, rates)
        return EulerianRun(eulerian, fluid, truth, start, settings.longest_step, courant, scene.tracers.interpolation)
    definition, seen = ModelDefinition.of(scene), None
    model = LagrangianModel({}, definition.units(truth.scales))
    if "model" in settings.form.needs:
        stored = load_weights(comm, trained, "model")
        model = trained_model(definition, stored, truth.scales, comm)
        seen = FeatureRange(**stored.tables["feature_range"]) if model.networks else None
    return ParticleRun(model.forced(forcing), seen, settings, truth, start, limited=step is None)


def forcing_of(power: str | float, section: ForcingSection | None, truth: GroundTruth) -> Forcing | None:
    """Return the forcing of a rollout, or None if the rollout is not forced.

    `power` is the key `injection` of [simulation]: "truth" for the forcing of the ground truth, "none" for no forcing,
    or a number, the power per mass. "dissipation" means the dissipation rate of the ground truth. Modes with
    |k| < k_f are forced, where k_f is the `wavenumber` of `section`, [forcing] of the scene, or 2 without it.
    """
    if power == "truth":
        return truth.forcing
    if power == "none":
        return None
    return Forcing(injection_rate=truth.reference["dissipation_rate"] if power == "dissipation" else power,
                   wavenumber=section.wavenumber if section else 2.0)
