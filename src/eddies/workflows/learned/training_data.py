"""What a scene's model is trained and validated on: frames and windows of a ground truth, in the units of its flow."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch

from eddies.clock import ProgressLine
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.rollout_training import RolloutTrainer, TrainingWindow
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.foreseen.ranks import ALLOWED_VELOCITY
from eddies.workflows.ground_truth.frame_counts import last_trained_on, trained_frames
from eddies.workflows.ground_truth.truth import GroundTruth, load_frame
from eddies.workflows.learned.model import scene_model

# On how many particles the error of the acceleration is measured; on how many cubes or batches that of all losses.
VALIDATION_PARTICLES, COMBINED_DRAWS = 8192, 8


class TrainingData:
    """The model of a scene in the units of a ground truth, with the frames and windows of this that it is trained and
    validated on, so many of each.

    `last` is the last frame of the training window, `learned` the last that is trained on; what lies between is for
    validation.

    Parameters
    ----------
    truth : which may be that of another flow.
    count : of the frames, and of the windows.
    like : model whose parameters this one shares; None: it has new ones.
    """

    def __init__(self, scene: Scene, truth: GroundTruth, count: int, device: torch.device,
                 like: LagrangianModel | None = None) -> None:
        self.scene, self.settings, self.truth, self.count, self.device = scene, scene.training, truth, count, device
        self.dtype = getattr(torch, self.settings.precision)
        self.model = model_of(scene, truth, device, like)
        self.longest = max(self.settings.horizons.frames) if self.settings.horizons else 0
        self.last = truth.last_frame_seen(self.settings.window)
        self.learned = last_trained_on(self.settings, len(truth.times))
        self.usable, self.held_out = trained_frames(self.settings, len(truth.times), truth.at_fields)

    @cached_property
    def frames(self) -> list[TrainingFrame]:
        """The single frames that are trained on; the first use is collective."""
        seen = np.array(self.usable)[np.unique(np.linspace(0, len(self.usable) - 1, self.count).astype(int))]
        progress, frames = ProgressLine("train", lambda: "prepared", unit="frame"), []
        for index in seen:
            frames.append(self._frame(index))
            progress(len(frames) / len(seen), len(frames))
        return frames

    def force_trainer(self, kernel: SmoothingKernel | None) -> ForceTrainer:
        """What trains the model on single frames."""
        settings = self.settings
        weights = LossWeights(settings.field_weight, settings.velocity_kl_weight, settings.acceleration_kl_weight,
                              settings.power_weight)
        return ForceTrainer(self.model, self.frames, kernel, weights, settings.batch, self.scene.seed)

    def validation_frame(self) -> TrainingFrame:
        """The last frame of the training window that is held out; collective."""
        return self._frame(self.held_out)

    def rollout_trainer(self) -> tuple[RolloutTrainer, TrainingWindow]:
        """What trains the model on windows of frames, and the window for validation; collective."""
        settings, scene = self.settings.horizons, self.scene
        interval, slab = scene.tracers.frame_interval, self.truth.decomposition
        drift = ALLOWED_VELOCITY * self.model.flow.scales.velocity * interval * self.longest
        dynamics = ParticleDynamics(slab, self.model, 0.0, self.dtype, fixed_ranks=True, drift=drift)
        resolution = dynamics.resolution
        if resolution is None and settings.energy_weight > 0:
            resolution = ResolvedVelocity.on_slabs(slab, self.model.flow, drift, self.dtype)
        if resolution is not None:
            # Gradients are those of the particles alone: what is foreseen may not be part of the result.
            resolution.tolerance_foreseen = resolution.tolerance
        starts = np.unique(np.linspace(0, self.learned - self.longest, self.count).astype(int))
        windows = [self._window(start, resolution) for start in starts]
        substeps = round(interval / (settings.time_step or interval))
        trainer = RolloutTrainer(slab.comm, INTEGRATORS[settings.integrator](dynamics), windows, interval,
                                 substeps, settings.energy_weight, resolution, scene.seed,
                                 stationary=self.truth.forcing is not None)
        return trainer, self._window(self.last - self.longest, resolution)

    def _frame(self, index: int) -> TrainingFrame:
        return load_frame(self.truth, index, self.model, self.dtype, self.device, self.settings.wants_fields)

    def _window(self, start: int, resolution: ResolvedVelocity | None) -> TrainingWindow:
        columns = {name: torch.from_numpy(column).to(self.device)
                   for name, column in self.truth.window(start, self.longest).items()}
        later = {name: columns.pop(f"{name}_later").movedim(1, 0).contiguous()
                 for name in ("position", "velocity", "density") if f"{name}_later" in columns}
        particles = ParticleSet(**columns)
        if not self.model.integrates_density:
            particles = replace(particles, density=None)
        # Positions are stored within the box; here they go on from where the particles are.
        position = particles.position + PeriodicBox(BOX_LENGTH).displacement(later["position"], particles.position)
        moments = [particles, *(ParticleSet(particles.id, *moved) for moved in zip(position, later["velocity"]))]
        energies = None
        if self.settings.horizons.energy_weight > 0:
            with torch.no_grad():
                energies = torch.stack([resolution.band_energies(moment) for moment in moments])
        return TrainingWindow(particles, later["velocity"], later.get("density"), energies)


def model_of(scene: Scene, truth: GroundTruth, device: torch.device,
             like: LagrangianModel | None = None) -> LagrangianModel:
    """The scene's model in the units of a ground truth and with the forcing that stayed on there, in the precision of
    the training; with new parameters, or those of the same terms in the units of another."""
    model = scene_model(scene, truth.scales, truth.decomposition.comm)
    model = model.to(dtype=getattr(torch, scene.training.precision), device=device)
    if like is not None:
        model.share_parameters(like)
    return model.forced(truth.forcing)
