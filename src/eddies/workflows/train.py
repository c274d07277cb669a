"""Train the particle model on tracers of the training window, then test it a priori at other times."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from eddies.io.checkpoint import Guard
from eddies.io.provenance import product_provenance
from eddies.io.weights import save_weights
from eddies.io.new_files import write_files
from eddies.learning.training import Training
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows.ground_truth.frame_counts import last_seen
from eddies.workflows.learned import transfer
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.model import load_form
from eddies.workflows.learned.source import ModelDefinition
from eddies.workflows.learned.training_data import model_for, training_data
from eddies.workflows.learned.training_phases import feature_range, horizon_phases, one_step_phases, take_all_steps
from eddies.workflows.learned.truths import open_truths
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance

log = logging.getLogger("eddies")

# Wall seconds between two drawings of the learning curves.
DRAWING_SECONDS = 30.0


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Train the model of a scene and write model.h5: weights, learning history, a-priori tests and feature range.

    With [model] path the weights of another run are used, without training. A stopped training continues from its
    newest checkpoint.
    """
    directory = Path(directory)
    if scene.model.path is not None:
        transfer.run(scene, comm, directory)
        return
    definition, settings, device = ModelDefinition.of(scene), scene.training, prepare_torch(scene.device, comm)
    own_file = directory / STAGES["dns"].file
    with open_truths(own_file, settings.truth_files, comm, device) as (truth, trained_on):
        # Only the field loss averages with the kernel.
        kernel_file = directory / STAGES["train-kernel"].file
        kernel = load_form(comm, kernel_file, truth.scales, truth.device).kernel if settings.field_weight > 0 else None
        data, tests = training_data(definition, settings, trained_on), evaluation_frames(truth)
        model, dtype = data[0].model, data[0].dtype
        for each in data:
            log.info("train: %d parameters; trains on frames up to %d and keeps the next %d for validation; the "
                     "training window ends at t = %.3g, the ground truth at t = %.3g",
                     sum(p.numel() for p in model.parameters()), each.learned, each.last - each.learned,
                     each.truth.times[each.last], each.truth.times[-1])
        own = next((each.model for each in data if each.truth is truth), None)
        # If the model is trained only on other ground truths, it has seen no part of this run's ground truth.
        last = last_seen(settings.window if own is not None else 0.0, len(truth.times))
        guard = Guard(comm, directory / STAGES["train"].checkpoints, stage_fingerprint(scene, "train"), stop,
                      " of the training")
        history, cost, curves = {}, [], None
        learns = next(model.parameters(), None) is not None
        phases = [*one_step_phases(data, kernel), *horizon_phases(data)] if learns else []
        if not phases:
            log.info("train: no training, because the terms have no parameters or [training] has no steps")
        else:
            training, curves = Training(comm, model, phases), LearningCurves(comm, directory / "learning.png")
            take_all_steps(training, guard, "train", "training", "lower learning_rate here or in [training.horizons], "
                           "or shorten time_step there", curves)
            history, cost = {"history": training.columns()}, training.cost
        tested = model_for(definition, truth, dtype, model) if own is None else own
        tables = history | evaluate(truth, tested, tests, last, dtype)
        if model.networks:
            tables["feature_range"] = vars(feature_range(data))
        description = definition.describe(truth.scales) | {"training": cost,
                                                           "coefficients": tested.learned_coefficients}
        of_named = {str(path): truth.reference.get("mach_turbulent")
                    for path, truth in zip(settings.truth_files, trained_on)}
        provenance = {**stage_provenance(scene, "train"), "mach_turbulent": truth.reference.get("mach_turbulent"),
                      "truths": {path: product_provenance(path).get("id") for path in of_named},
                      "mach_of_truths": of_named}
    weights = {name: tensor.cpu().numpy() for name, tensor in model.state_dict().items()}
    save_weights(comm, directory / STAGES["train"].file, "model", description, weights, provenance, tables)
    guard.checkpoints.remove()
    if curves is not None:  # after the product is written: a failing picture must not lose it
        curves.draw(training)
    errors = tables["a_priori"]
    beside = (f" (the exact filtered pressure gradient alone: {errors['pressure_gradient_error'][-1]:.3f})"
              if "pressure_gradient_error" in errors else "")
    since = ("end of the training window" if own is not None
             else "release of the tracers; trained on other ground truths")
    log.info("model: a-priori acceleration error %.3f%s, measured a time of %.3g after the %s",
             errors["acceleration_error"][-1], beside, errors["delay"][-1], since)


class LearningCurves:
    """Draws the history of a training to a file now and then, on rank 0. A failure is logged once as a warning."""

    def __init__(self, comm: Comm, path: Path) -> None:
        self.comm, self.path, self._drawn, self._failed = comm, path, time.monotonic(), False

    def __call__(self, training: Training) -> None:
        """Draw if DRAWING_SECONDS have passed since the last drawing."""
        if time.monotonic() - self._drawn > DRAWING_SECONDS:
            self.draw(training)

    def draw(self, training: Training) -> None:
        """Draw now, on rank 0."""
        self._drawn = time.monotonic()
        if self.comm.rank > 0 or self._failed:
            return
        try:
            from eddies.report import figures  # matplotlib takes a while to start
            from eddies.report.learning import curves
            write_files({self.path: figures.png(curves(training.columns()))})
        except (Exception, SystemExit) as error:  # from matplotlib, its settings or the disk: the training continues
            self._failed = True
            log.warning("train: cannot draw %s (%s: %s); the training continues without it", self.path,
                        type(error).__name__, error)
