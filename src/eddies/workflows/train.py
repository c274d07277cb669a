"""The particle model: trained on tracers of the training window, then tested a priori at other times."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from eddies.io.checkpoint import Guard
from eddies.io.weights import save_weights
from eddies.io.new_files import write_files
from eddies.learning.training import Training
from eddies.parallel.communicator import Comm
from eddies.parallel.stop import StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows.learned import transfer
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.model import load_kernel
from eddies.workflows.learned.source import describe
from eddies.workflows.learned.steps import take_all_steps
from eddies.workflows.learned.training_data import model_of
from eddies.workflows.learned.training_phases import feature_range, horizon_phases, one_step_phases
from eddies.workflows.learned.truths import open_truths, training_data, truth_ids
from eddies.workflows.run_directory.fingerprints import stage_fingerprint, stage_provenance

log = logging.getLogger("eddies")

# Wall seconds between two drawings of the learning curves.
DRAWING_SECONDS = 30.0


def run(scene: Scene, comm: Comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Train the model of a scene and write model.h5: weights, learning history, a-priori tests, and the range of
    what its networks were given.

    With [model] path its weights are taken instead. A training that is stopped goes on from a checkpoint.
    """
    if scene.model.path is not None:
        transfer.run(scene, comm, directory)
        return
    device, directory = prepare_torch(scene.device, comm), Path(directory)
    with open_truths(scene, comm, directory) as (truth, trained_on):
        # Only the field loss averages with it.
        kernel = load_kernel(comm, directory / "kernel.h5", device) if scene.training.field_weight > 0 else None
        data, tests = training_data(scene, trained_on, device), evaluation_frames(truth)
        model = data[0].model
        for each in data:
            log.info("train: frames up to %d of the times up to %.3g of %.3g, %d held out; %d weights", each.learned,
                     each.truth.times[each.last], each.truth.times[-1], each.last - each.learned,
                     sum(p.numel() for p in model.parameters()))
        own = next((each.model for each in data if each.truth is truth), None)
        # Nothing of the run's own ground truth is seen where others are trained on.
        last = truth.last_frame_seen(scene.training.window if own is not None else 0.0)
        guard = Guard(comm, directory / STAGES["train"].checkpoints, stage_fingerprint(scene, "train"), stop,
                      " of the training")
        history, cost, curves = {}, [], None
        phases = []
        if next(model.parameters(), None) is not None:
            phases = [*one_step_phases(scene, data, kernel), *horizon_phases(scene, data)]
        if not phases:
            log.info("train: the terms have no parameters, or [training] no steps: nothing is learned")
        else:
            training, curves = Training(comm, model, phases), LearningCurves(comm, directory / "learning.png")
            take_all_steps(training, guard, "train", "training", "lower learning_rate here or in [training.horizons], "
                           "or shorten time_step there", curves)
            history, cost = {"history": training.columns()}, training.cost
        tested = model_of(scene, truth, device, model) if own is None else own
        tables = history | evaluate(truth, tested, tests, last, data[0].dtype, device)
        if model.networks:
            tables["feature_range"] = vars(feature_range(data))
        mach = truth.reference.get("mach_turbulent")
        description = describe(scene, truth.scales) | {"training": cost, "coefficients": tested.learned_coefficients}
        mach_of_truths = {str(path): each.reference.get("mach_turbulent")
                          for path, each in zip(scene.training.truth_files, trained_on)}
    weights = {name: tensor.cpu().numpy() for name, tensor in model.state_dict().items()}
    save_weights(comm, directory / "model.h5", "model", description, weights,
                 {**stage_provenance(scene, "train"), "mach_turbulent": mach, "truths": truth_ids(scene),
                  "mach_of_truths": mach_of_truths}, tables)
    guard.checkpoints.remove()
    if curves is not None:  # after the product, which no picture may cost
        curves.draw(training)
    errors = tables["a_priori"]
    beside = (f" (exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f})"
              if "pressure_gradient_error" in errors else "")
    since = "training window" if own is not None else "release of tracers that were not trained on"
    log.info("model: acceleration error %.3f at a time %.3g after the %s%s", errors["acceleration_error"][-1],
             errors["delay"][-1], since, beside)


class LearningCurves:
    """Draws the history of a training to a file now and then, on rank 0. A picture that fails is a warning, once."""

    def __init__(self, comm: Comm, path: Path) -> None:
        self.comm, self.path, self._drawn, self._failed = comm, path, time.monotonic(), False

    def __call__(self, training: Training) -> None:
        """Draw if it is time."""
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
        except (Exception, SystemExit) as error:  # of matplotlib, its settings, the disk: no reason to lose a training
            self._failed = True
            log.warning("train: %s cannot be drawn (%s: %s); the training goes on without it", self.path,
                        type(error).__name__, error)
