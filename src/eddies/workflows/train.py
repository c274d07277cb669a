"""The pair-force model: trained on tracers of the training window, then tested a priori at other times."""

from __future__ import annotations

import logging
import time
from pathlib import Path

import numpy as np
import torch

from eddies.clock import ProgressLine
from eddies.io.hdf5 import open_product
from eddies.io.weights import save_weights
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.losses import relative_error
from eddies.learning.optimization import Descent
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.stop import StopRequest
from eddies.particles.pair_forces import PairModel
from eddies.scene import BOX_LENGTH, Scene, SceneError
from eddies.workflows.a_priori import evaluate, evaluation_frames
from eddies.workflows.closures import load_kernel, poisson_closure
from eddies.workflows.devices import prepare_torch
from eddies.workflows.truth import GroundTruth, load_frame

log = logging.getLogger("eddies")

# How many rows of validation error the history holds, and on how many particles each is measured.
VALIDATIONS, VALIDATION_PARTICLES = 25, 8192


def run(scene: Scene, comm, directory: str | Path, stop: StopRequest | None = None) -> None:
    """Train the model of a scene and write model.h5: weights, learning history and a-priori tests."""
    device = prepare_torch(scene.device, comm)
    directory, settings = Path(directory), scene.training
    dtype = getattr(torch, settings.precision)
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.particles_per_side)
    with open_product(comm, directory / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, slab)
        kernel = load_kernel(comm, directory / "kernel.h5", device)
        model = build_model(scene, truth, kernel.support).to(dtype=dtype, device=device)
        last, tests = truth.last_frame_seen(settings.window), evaluation_frames(truth)
        if last < 2:
            raise SceneError(f"[training] window = {settings.window:g}: holds fewer than three frames of the ground "
                             "truth; raise it or [tracers] turnovers, or lower [tracers] frame_interval")
        seen = np.unique(np.linspace(1, last - 1, settings.frames).astype(int))
        log.info("train: %d frames of the times up to %.3g of %.3g; %d weights", len(seen), truth.times[last],
                 truth.times[-1], sum(p.numel() for p in model.parameters()))
        closure = poisson_closure(slab, truth.scales.sound_speed, dtype) if model.closure == "poisson" else None
        frames = [load_frame(truth, index, model, closure, dtype, device) for index in seen]
        validation = load_frame(truth, tests[-1], model, closure, dtype, device)
        weights = LossWeights(settings.trajectory_weight, settings.field_weight, settings.velocity_kl_weight,
                              settings.acceleration_kl_weight)
        trainer = ForceTrainer(model, frames, kernel, weights, settings.batch, scene.seed)
        history = train(scene, trainer, validation, stop or StopRequest(comm))
        tables = evaluate(truth, model, closure, tests, last, dtype, device)
    weights = {name: tensor.cpu().numpy() for name, tensor in model.state_dict().items()}
    provenance = {"scene": scene.to_toml(), "fingerprint": scene.fingerprint("train")}
    save_weights(comm, directory / "model.h5", "model", model.state_description(), weights, provenance,
                 {"history": history, **tables})
    errors = tables["a_priori"]
    log.info("model: acceleration error %.3f at a time %.3g after the training window (exact filtered pressure "
             "gradient %.3f)", errors["acceleration_error"][-1], errors["delay"][-1],
             errors["pressure_gradient_error"][-1])


def build_model(scene: Scene, truth: GroundTruth, support: float) -> PairModel:
    """An untrained model of the form that the scene asks for, with the scales of the ground truth."""
    form = scene.model
    return PairModel(truth.scales, support, scene.kernel.neighbors, form.hidden, form.basis, form.closure,
                     form.eddy_viscosity, scene.seed)


def train(scene: Scene, trainer: ForceTrainer, validation: TrainingFrame,
          stop: StopRequest) -> dict[str, np.ndarray]:
    """Take all steps of a scene's training and return its history by column; NaN where a loss was not in use."""
    settings, started = scene.training, time.perf_counter()
    descent = Descent(trainer.comm, trainer.model.parameters(), settings.steps, settings.learning_rate,
                      settings.final_learning_rate)
    names = ("step", "loss", "trajectory_loss", "field_loss", "velocity_kl_loss", "acceleration_kl_loss",
             "validation_error", "learning_rate", "gradient_norm", "seconds")
    rows: list[dict[str, float]] = []
    last_error = np.nan

    def describe() -> str:
        return f"loss {rows[-1]['loss']:.4f}  validation error {last_error:.3f}"

    progress = ProgressLine("train", describe)
    for step in range(settings.steps):
        stop.check()
        combined = step >= settings.steps - settings.combined_steps
        rate = descent.learning_rate
        losses = (trainer.combined_step if combined else trainer.trajectory_step)(descent, step)
        row = dict.fromkeys(names, np.nan) | losses
        row |= {"step": step, "learning_rate": rate, "seconds": time.perf_counter() - started}
        if (step + 1) % max(settings.steps // VALIDATIONS, 1) == 0:
            last_error = row["validation_error"] = validation_error(trainer, validation)
        rows.append(row)
        progress((step + 1) / settings.steps, step + 1)
    return {name: np.array([row[name] for row in rows]) for name in names}


@torch.no_grad()
def validation_error(trainer: ForceTrainer, frame: TrainingFrame) -> float:
    """Normalised L2 error of the acceleration on a fixed sample of the particles of a frame; collective."""
    total = trainer.total
    ids = np.random.default_rng(trainer.seed).choice(total, min(VALIDATION_PARTICLES, total), replace=False)
    rows = frame.rows(ids)
    return relative_error(trainer.comm, frame.errors(rows)["velocity"], frame.acceleration[rows])
