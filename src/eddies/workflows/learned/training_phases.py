"""The phases of a training, and the loop over its steps.

If there are several ground truths, the steps alternate between them, and a validation error is the mean over them.
"""

import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from statistics import fmean
from typing import TypeVar

import numpy as np

from eddies.clock import ProgressLine
from eddies.io.checkpoint import Guard
from eddies.learning.training import Adam, Phase, Training, TrainingDiverged
from eddies.parallel.halo import HaloError
from eddies.particles.feature_range import FeatureRange, pair_features
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.scene.scene import SceneError
from eddies.scene.values import import_paths
from eddies.workflows.learned.model import load_form
from eddies.workflows.learned.training_data import TrainingData

log = logging.getLogger("eddies")

# Number of particles for the validation error of the acceleration, and number of cubes or batches for that of all
# losses.
VALIDATION_PARTICLES, COMBINED_DRAWS = 8192, 8
# Number of validations in a phase on single frames, and in a phase on windows.
VALIDATIONS, HORIZON_VALIDATIONS = 25, 4
# Least number of validations within the patience of a phase.
LEAST_VALIDATIONS = 4
# Losses of the training on windows that the progress line shows, and their names there.
HORIZON_LOSSES = {"rollout_loss": "velocity", "density_loss": "density", "energy_loss": "energy"}

Trainer = TypeVar("Trainer")


def training_phases(data: Sequence[TrainingData], kernel_file: Path) -> list[Phase]:
    """Return all phases of a training; none if the model has no parameters. The kernel is read only for a field
    loss."""
    if next(data[0].model.parameters(), None) is None:
        return []
    kernel, truth = None, data[0].truth
    if data[0].settings.field_weight > 0:
        kernel = load_form(truth.decomposition.comm, kernel_file, truth.scales, truth.device).kernel
    return [*one_step_phases(data, kernel), *horizon_phases(data)]


def one_step_phases(data: Sequence[TrainingData], kernel: SmoothingKernel | None) -> list[Phase]:
    """Return the phases of training on rates of single frames: first with the trajectory loss alone, then with all
    losses."""
    settings = data[0].settings
    if [*import_paths(data[0].definition.model)]:  # terms or networks of the user
        first = data[0].frames[0]
        data[0].model.check_terms(first.dynamics.context(first.particles))
    trainers = [each.force_trainer(kernel) for each in data]
    held_out = [each.validation_frame() for each in data]
    alone = settings.steps - settings.combined_steps
    fall = settings.final_learning_rate / settings.learning_rate
    between = settings.learning_rate * fall ** (alone / max(settings.steps, 1))

    def phase(name: str, steps: int, rates: tuple[float, float], take, error) -> Phase:
        # The unit of work is one evaluation of the force on one particle.
        work = np.array([float(_at_turn(trainers, step).batch) for step in range(steps)])
        every = max(min(steps // VALIDATIONS, (settings.patience or steps) // LEAST_VALIDATIONS), 1)
        return Phase(name, work, rates, lambda optimizer, step: take(_at_turn(trainers, step), optimizer, step),
                     _mean(error, trainers, held_out), every, settings.patience)

    phases = [phase("one step", alone, (settings.learning_rate, between),
                    lambda trainer, optimizer, step: trainer.trajectory_step(optimizer, step),
                    lambda trainer, frame: trainer.one_step_error(frame, VALIDATION_PARTICLES)),
              phase("all losses", settings.combined_steps, (between, settings.final_learning_rate),
                    lambda trainer, optimizer, step: trainer.combined_step(optimizer, step),
                    lambda trainer, frame: trainer.combined_error(frame, COMBINED_DRAWS))]
    return [phase for phase in phases if phase.steps]


def horizon_phases(data: Sequence[TrainingData]) -> list[Phase]:
    """Return the phases of training on windows of frames, one for each horizon in [training.horizons]."""
    settings = data[0].settings.horizons
    if settings is None:
        return []
    trainers, held_out = zip(*(each.rollout_trainer() for each in data))
    longest = max(settings.frames)
    rates = settings.learning_rate, data[0].settings.final_learning_rate
    every = max(settings.steps // HORIZON_VALIDATIONS, 1)

    def phase(number: int, horizon: int) -> Phase:
        first = number * settings.steps

        def take(optimizer: Adam, step: int) -> dict[str, float]:
            return _at_turn(trainers, first + step).step(optimizer, first + step, horizon)

        # Each step through a window is evaluated, evaluated again in the backward pass, and differentiated.
        at_turn = [_at_turn(trainers, first + step) for step in range(settings.steps)]
        work = np.array([3.0 * trainer.steps_per_frame * horizon * trainer.total for trainer in at_turn])
        # The error at the longest horizon validates all phases, because the last phase must minimise it.
        error = _mean(lambda trainer, window: trainer.validation_error(window, longest), trainers, held_out)
        return Phase(f"horizon {horizon}", work, rates, take, error, every)

    return [phase(number, horizon) for number, horizon in enumerate(settings.frames)]


def feature_range(data: Sequence[TrainingData]) -> FeatureRange:
    """Return the range of the network inputs over all pairs in the training frames; collective.

    States that the model itself reaches in the training through horizons are left out, because they are not true
    states.
    """
    blocks = (block for each in data for frame in each.frames
              for block in pair_features(frame.dynamics, frame.seen()))
    return FeatureRange.of(data[0].truth.decomposition.comm, blocks)


def _at_turn(trainers: Sequence[Trainer], step: int) -> Trainer:
    return trainers[step % len(trainers)]


def _mean(error: Callable, trainers: Sequence, held_out: Sequence) -> Callable[[], float]:
    return lambda: fmean([error(trainer, moment) for trainer, moment in zip(trainers, held_out)])


def take_all_steps(training: Training, guard: Guard, stage: str, section: str, remedy: str,
                   after_each: Callable[[Training], None] = lambda training: None) -> None:
    """Run a training to its end, from its newest checkpoint if one exists. Log lines begin with `stage`, and
    `after_each` is called after each step.

    Raises Stopped after a checkpoint if a stop is requested. Raises SceneError if the training diverges; the text names
    the `section` and the `remedy`.
    """
    saved = guard.checkpoints.newest()
    if saved is not None:
        training.load_state_dict(saved)
        log.info("%s: continues from step %d", stage, training.steps)

    def describe() -> str:
        last = training.history[-1]
        errors = [row["validation_error"] for row in training.history if "validation_error" in row]
        parts = ", ".join(f"{name} {last[key]:.3g}" for key, name in HORIZON_LOSSES.items() if key in last)
        shown = (f" ({parts})" if parts else "") + (f"  validation error {errors[-1]:.3f}" if errors else "")
        return f"{training.phase.name}  loss {last['loss']:.4f}{shown}"

    progress = ProgressLine(stage, describe, done=training.done)
    while training.running:
        guard(training)
        phase = training.phase_number
        try:
            training.step()
        except (TrainingDiverged, HaloError) as error:
            raise SceneError(f"[{section}] {error}; {remedy}") from None
        if training.running:
            progress(training.done, training.steps)
        if training.phase_number != phase:
            progress.renew()
        after_each(training)
