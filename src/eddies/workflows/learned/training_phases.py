"""The phases of a scene's training, on one ground truth or several: they take turns, a step each, and an error on what
is held out is the mean of theirs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from statistics import fmean
from typing import TypeVar

import numpy as np

from eddies.learning.optimization import Adam
from eddies.learning.training import Phase
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.scene.scene import Scene
from eddies.workflows.learned.training_data import COMBINED_DRAWS, VALIDATION_PARTICLES, TrainingData

# How many validations a phase has.
VALIDATIONS, HORIZON_VALIDATIONS = 25, 4
# How many validations at least before the patience of a phase is at its end.
LOOKS = 4

Trainer = TypeVar("Trainer")


def one_step_phases(scene: Scene, data: Sequence[TrainingData], kernel: SmoothingKernel | None) -> list[Phase]:
    """Steps on the rates of single frames: on trajectories, then on all losses, as far as the scene has them."""
    settings = scene.training
    if scene.model.foreign:
        first = data[0].frames[0]
        data[0].model.require_linear(first.dynamics.context(first.particles))
    trainers = [each.force_trainer(kernel) for each in data]
    held_out = [each.validation_frame() for each in data]
    alone = settings.steps - settings.combined_steps
    fall = settings.final_learning_rate / settings.learning_rate
    between = settings.learning_rate * fall ** (alone / max(settings.steps, 1))

    def phase(name: str, steps: int, rates: tuple[float, float], take, error) -> Phase:
        # Work in evaluations of the force of a particle.
        work = np.array([float(_at_turn(trainers, step).batch) for step in range(steps)])
        return Phase(name, work, rates, lambda optimizer, step: take(_at_turn(trainers, step), optimizer, step),
                     _mean(error, trainers, held_out), every(steps), settings.patience)

    def every(steps: int) -> int:
        return max(min(steps // VALIDATIONS, (settings.patience or steps) // LOOKS), 1)

    phases = [phase("one step", alone, (settings.learning_rate, between),
                    lambda trainer, optimizer, step: trainer.trajectory_step(optimizer, step),
                    lambda trainer, frame: trainer.one_step_error(frame, VALIDATION_PARTICLES)),
              phase("all losses", settings.combined_steps, (between, settings.final_learning_rate),
                    lambda trainer, optimizer, step: trainer.combined_step(optimizer, step),
                    lambda trainer, frame: trainer.combined_error(frame, COMBINED_DRAWS))]
    return [phase for phase in phases if phase.steps]


def horizon_phases(scene: Scene, data: Sequence[TrainingData]) -> list[Phase]:
    """Steps through windows of frames, one phase for each horizon of the scene."""
    settings = scene.training.horizons
    if settings is None:
        return []
    trainers, held_out = zip(*(each.rollout_trainer() for each in data))
    longest = max(settings.frames)
    rates = settings.learning_rate, scene.training.final_learning_rate
    every = max(settings.steps // HORIZON_VALIDATIONS, 1)

    def phase(number: int, horizon: int) -> Phase:
        first = number * settings.steps

        def take(optimizer: Adam, step: int) -> dict[str, float]:
            return _at_turn(trainers, first + step).step(optimizer, first + step, horizon)

        # Each step through a window is evaluated, evaluated again on the way back, and differentiated.
        at_turn = [_at_turn(trainers, first + step) for step in range(settings.steps)]
        work = np.array([3.0 * trainer.steps_per_frame * horizon * trainer.total for trainer in at_turn])
        # All horizons are measured by the longest: a shorter one is a way to it.
        error = _mean(lambda trainer, window: trainer.validation_error(window, longest), trainers, held_out)
        return Phase(f"horizon {horizon}", work, rates, take, error, every)

    return [phase(number, horizon) for number, horizon in enumerate(settings.frames)]


def feature_range(data: Sequence[TrainingData]) -> FeatureRange:
    """The range of what the networks are given by all pairs of the frames that are trained on; collective.

    Where the simulation leads within the horizons is left out, as it is not the truth.
    """
    blocks = (block for each in data for frame in each.frames
              for block in pair_features(frame.dynamics, frame.seen()))
    return FeatureRange.of(data[0].truth.decomposition.comm, blocks)


def _at_turn(trainers: Sequence[Trainer], step: int) -> Trainer:
    return trainers[step % len(trainers)]


def _mean(error: Callable, trainers: Sequence, held_out: Sequence) -> Callable[[], float]:
    return lambda: fmean([error(trainer, moment) for trainer, moment in zip(trainers, held_out)])
