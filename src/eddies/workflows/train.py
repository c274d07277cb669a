"""The particle model: trained on tracers of the training window, then tested a priori at other times."""

from __future__ import annotations

import logging
import time
from pathlib import Path

from eddies.clock import ProgressLine
from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.hdf5 import in_files, open_product
from eddies.io.weights import save_weights
from eddies.learning.training import Training, TrainingDiverged
from eddies.parallel.communicator import Comm
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import any_rank
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import Stopped, StopRequest
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned import transfer
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.description import describe
from eddies.workflows.learned.kernel import load_kernel
from eddies.workflows.learned.training_data import TrainingData

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
    device, directory, stop = prepare_torch(scene.device, comm), Path(directory), stop or StopRequest(comm)
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes))
        # Only the field loss averages with it.
        kernel = load_kernel(comm, directory / "kernel.h5", device) if scene.training.field_weight > 0 else None
        data = TrainingData(scene, truth, kernel, device)
        model, last, tests = data.model, data.last, evaluation_frames(truth)
        log.info("train: frames up to %d of the times up to %.3g of %.3g, %d held out; %d weights", data.learned,
                 truth.times[last], truth.times[-1], last - data.learned, sum(p.numel() for p in model.parameters()))
        checkpoints = CheckpointDirectory(comm, directory / STAGES["train"].checkpoints, scene.fingerprint("train"))
        history = {}
        if next(model.parameters(), None) is None:
            log.info("train: the terms have no parameters, nothing is learned")
        else:
            phases = [*data.one_step_phases(), *data.horizon_phases()]
            training = Training(comm, model, phases)
            take_all_steps(training, checkpoints, stop, LearningCurves(comm, directory / "learning.png"))
            history = {"history": training.columns()}
        tables = history | evaluate(truth, model, tests, last, data.dtype, device)
        if model.networks:
            tables["feature_range"] = vars(data.feature_range())
        mach, description = truth.reference.get("mach_turbulent"), describe(scene, truth.scales)
    weights = {name: tensor.cpu().numpy() for name, tensor in model.state_dict().items()}
    save_weights(comm, directory / "model.h5", "model", description, weights,
                 {**scene.provenance("train"), "mach_turbulent": mach}, tables)
    checkpoints.remove()
    errors = tables["a_priori"]
    beside = (f" (exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f})"
              if "pressure_gradient_error" in errors else "")
    log.info("model: acceleration error %.3f at a time %.3g after the training window%s",
             errors["acceleration_error"][-1], errors["delay"][-1], beside)


def take_all_steps(training: Training, checkpoints: CheckpointDirectory, stop: StopRequest,
                   curves: LearningCurves) -> None:
    """Take a training to its end, from its newest checkpoint if there is one.

    Raises Stopped, once a checkpoint is safe, where it is asked to.
    """
    saved = checkpoints.newest()
    if saved is not None:
        training.load_state_dict(saved)
        log.info("train: goes on from step %d", len(training.history))

    def describe() -> str:
        errors = [row["validation_error"] for row in training.history if "validation_error" in row]
        shown = f"  validation error {errors[-1]:.3f}" if errors else ""
        return f"{training.phase.name}  loss {training.history[-1]['loss']:.4f}{shown}"

    progress = ProgressLine("train", describe)
    while training.running:
        stopping = stop()
        if stop.checkpoint_due:
            checkpoints.write(len(training.history), training.state_dict())
            stop.checkpoint_done()
        if stopping:
            raise Stopped(stop.reason, f"from step {len(training.history)} of the training")
        try:
            training.step()
        except (TrainingDiverged, HaloError) as error:
            raise SceneError(f"[training] {error}; lower learning_rate here or in [training.horizons], or shorten "
                             "time_step there") from None
        if training.running:
            progress(training.done, len(training.history))
        curves(training)
    curves.draw(training)


class LearningCurves:
    """Draws the history of a training to a file now and then; rank 0 does it, and all ranks raise a ProductError where
    it cannot."""

    def __init__(self, comm: Comm, path: Path) -> None:
        self.comm, self.path, self._drawn = comm, path, time.monotonic()

    def __call__(self, training: Training) -> None:
        """Draw if it is time; all ranks call it, with one small message."""
        if any_rank(self.comm, time.monotonic() - self._drawn > DRAWING_SECONDS):
            self.draw(training)

    def draw(self, training: Training) -> None:
        """Draw now; all ranks call it."""
        def write() -> None:
            from eddies.report import figures  # matplotlib takes a while to start
            from eddies.report.learning import curves
            self.path.write_bytes(figures.png(curves(training.columns())))

        in_files(self.comm, self.path, write)
        self._drawn = time.monotonic()
