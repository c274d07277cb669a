"""What a scene's model is trained and validated on: frames and windows of the ground truth, in phases of training."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch

from eddies.clock import ProgressLine
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.losses import relative_error
from eddies.learning.optimization import Adam
from eddies.learning.rollout_training import RolloutTrainer, TrainingWindow
from eddies.learning.training import Phase
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.foreseen.estimates import ALLOWED_VELOCITY
from eddies.workflows.ground_truth.frame_counts import last_trained_on
from eddies.workflows.ground_truth.truth import GroundTruth, load_frame
from eddies.workflows.learned.model import scene_model

# How many validations a phase has, and on how many particles the error of the acceleration is measured.
VALIDATIONS, HORIZON_VALIDATIONS, VALIDATION_PARTICLES = 25, 4, 8192
# How many cubes or batches the error of all losses together is measured on.
COMBINED_DRAWS = 8


class TrainingData:
    """The model of a scene with the frames and windows of the ground truth that it is trained and validated on.

    `last` is the last frame of the training window, `learned` the last that is trained on; what lies between is for
    validation.
    """

    def __init__(self, scene: Scene, truth: GroundTruth, kernel: SmoothingKernel | None, device: torch.device) -> None:
        self.scene, self.settings, self.truth, self.kernel, self.device = scene, scene.training, truth, kernel, device
        self.dtype = getattr(torch, self.settings.precision)
        self.model = scene_model(scene, truth.scales).to(dtype=self.dtype, device=device)
        self.longest = max(self.settings.horizons.frames) if self.settings.horizons else 0
        self.last = truth.last_frame_seen(self.settings.window)
        self.learned = last_trained_on(self.settings, len(truth.times))

    @cached_property
    def frames(self) -> list[TrainingFrame]:
        """The single frames that are trained on; the first use is collective."""
        seen = np.unique(np.linspace(1, self.learned, self.settings.frames).astype(int))
        progress, frames = ProgressLine("train", lambda: "of preparing frames"), []
        for index in seen:
            frames.append(self._frame(index))
            progress(len(frames) / len(seen), len(frames))
        return frames

    def feature_range(self) -> FeatureRange:
        """The range of what the networks are given by all pairs of these frames; collective.

        Where the simulation leads within the horizons is left out, as it is not the truth.
        """
        blocks = (block for frame in self.frames for block in pair_features(frame.dynamics, frame.seen()))
        return FeatureRange.of(self.truth.decomposition.comm, blocks)

    def one_step_phases(self) -> list[Phase]:
        """Steps on the rates of single frames: on trajectories, then on all losses, as far as the scene has them."""
        settings = self.settings
        if self.scene.model.foreign:
            first = self.frames[0]
            self.model.require_linear(first.dynamics.context(first.particles))
        validation = self._frame(self.last - 1)
        weights = LossWeights(settings.field_weight, settings.velocity_kl_weight, settings.acceleration_kl_weight)
        trainer = ForceTrainer(self.model, self.frames, self.kernel, weights, settings.batch, self.scene.seed)
        alone = settings.steps - settings.combined_steps
        fall = settings.final_learning_rate / settings.learning_rate
        between = settings.learning_rate * fall ** (alone / settings.steps)

        def phase(name: str, steps: int, rates: tuple[float, float], take, validate) -> Phase:
            # Work in evaluations of the force of a particle.
            work = np.full(steps, float(trainer.batch))
            return Phase(name, work, rates, take, validate, max(steps // VALIDATIONS, 1))

        phases = [phase("one step", alone, (settings.learning_rate, between), trainer.trajectory_step,
                        lambda: acceleration_error(trainer, validation)),
                  phase("all losses", settings.combined_steps, (between, settings.final_learning_rate),
                        trainer.combined_step, lambda: trainer.combined_error(validation, COMBINED_DRAWS))]
        return [phase for phase in phases if phase.steps]

    def horizon_phases(self) -> list[Phase]:
        """Steps through windows of frames, one phase for each horizon of the scene."""
        settings, scene = self.settings.horizons, self.scene
        if settings is None:
            return []
        interval, slab = scene.tracers.frame_interval, self.truth.decomposition
        drift = ALLOWED_VELOCITY * self.model.flow.scales.velocity * interval * self.longest
        dynamics = ParticleDynamics(slab, self.model, 0.0, self.dtype, fixed_ranks=True, drift=drift)
        if dynamics.resolution is not None:
            # Whose gradient is that of the particles alone: what is foreseen may not be part of the result.
            dynamics.resolution.tolerance_foreseen = dynamics.resolution.tolerance
        resolution = None
        if settings.energy_weight > 0:
            resolution = dynamics.resolution or ResolvedVelocity.on_slabs(slab, self.model.flow, drift, self.dtype)
        starts = np.unique(np.linspace(0, self.learned - self.longest, self.settings.frames).astype(int))
        windows = [self._window(start, resolution) for start in starts]
        validation = self._window(self.last - self.longest, resolution)
        substeps = round(interval / (settings.time_step or interval))
        trainer = RolloutTrainer(slab.comm, INTEGRATORS[settings.integrator](dynamics), windows, interval,
                                 substeps, settings.energy_weight, resolution and resolution.band_energies, scene.seed)
        rates = settings.learning_rate, self.settings.final_learning_rate
        every = max(settings.steps // HORIZON_VALIDATIONS, 1)

        def phase(number: int, horizon: int) -> Phase:
            def take(optimizer: Adam, step: int) -> dict[str, float]:
                return trainer.step(optimizer, number * settings.steps + step, horizon)

            # Each step through a window is evaluated, evaluated again on the way back, and differentiated.
            work = np.full(settings.steps, 3.0 * substeps * horizon * trainer.total)
            # All horizons are measured by the longest: a shorter one is a way to it.
            return Phase(f"horizon {horizon}", work, rates, take,
                         lambda: trainer.validation_error(validation, self.longest), every)

        return [phase(number, horizon) for number, horizon in enumerate(settings.frames)]

    def _frame(self, index: int) -> TrainingFrame:
        return load_frame(self.truth, index, self.model, self.dtype, self.device)

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
        if resolution is not None:
            with torch.no_grad():
                energies = torch.stack([resolution.band_energies(moment) for moment in moments])
        return TrainingWindow(particles, later["velocity"], later.get("density"), energies)


@torch.no_grad()
def acceleration_error(trainer: ForceTrainer, frame: TrainingFrame) -> float:
    """Normalised L2 error of the acceleration on a fixed sample of the particles of a frame; collective."""
    total = trainer.total
    ids = np.random.default_rng(trainer.seed).choice(total, min(VALIDATION_PARTICLES, total), replace=False)
    rows = frame.rows(ids)
    return relative_error(trainer.comm, frame.errors(rows)["acceleration"], frame.acceleration[rows])
