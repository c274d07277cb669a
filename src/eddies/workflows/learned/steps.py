"""The loop over the steps of a training."""

from __future__ import annotations

import logging
from collections.abc import Callable

from eddies.clock import ProgressLine
from eddies.io.guard import Guard
from eddies.learning.training import Training, TrainingDiverged
from eddies.parallel.halo import HaloError
from eddies.scene.scene import SceneError

log = logging.getLogger("eddies")


def take_all_steps(training: Training, guard: Guard, stage: str, section: str, remedy: str,
                   after_each: Callable[[Training], None] = lambda training: None) -> None:
    """Run a training to its end, from its newest checkpoint if one exists. Log lines begin with `stage`.

    Raises Stopped after a checkpoint if a stop is requested. Raises SceneError, which names the `section` and the
    `remedy`, if the training diverges.
    """
    saved = guard.checkpoints.newest()
    if saved is not None:
        training.load_state_dict(saved)
        log.info("%s: continues from step %d", stage, training.steps)

    def describe() -> str:
        last = training.history[-1]
        errors = [row["validation_error"] for row in training.history if "validation_error" in row]
        shown = f"  validation error {errors[-1]:.3f}" if errors else ""
        return f"{training.phase.name}  loss {last['loss']:.4f}{shown}"

    progress = ProgressLine(stage, describe, done=training.done)
    while training.running:
        guard(training)
        phase = training.number
        try:
            training.step()
        except (TrainingDiverged, HaloError) as error:
            raise SceneError(f"[{section}] {error}; {remedy}") from None
        if training.running:
            progress(training.done, training.steps)
        if training.number != phase:
            progress.renew()
        after_each(training)
