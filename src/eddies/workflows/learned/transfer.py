"""Use of a trained model on another flow: the weights of another run with the scales of this flow."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.provenance import others_trained_on
from eddies.io.weights import StoredWeights, save_weights
from eddies.parallel.communicator import Comm
from eddies.particles.devices import prepare_torch
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene
from eddies.workflows.ground_truth.frame_counts import last_seen
from eddies.workflows.ground_truth.truth import open_truth
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.model import load_model
from eddies.workflows.learned.source import ModelDefinition, read_source
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: Path) -> None:
    """Write model.h5 with the weights that [model] path names, without training; all ranks call it.

    Terms work in units of the flow (Eq. 4), so only the scales and the radius of interaction are those of this flow.
    Tables are copied from the source, except the a-priori tests, which are repeated on this flow. The tests on the flow
    of the training are kept as `source_a_priori` if the source has them. The cost of training is copied too.
    """
    definition = ModelDefinition.of(scene)
    source = read_source(scene.name, definition, comm)
    device = prepare_torch(scene.device, comm)
    with open_truth(comm, directory / STAGES["dns"].file, device) as truth:
        model = load_model(definition, comm, source.path, truth.scales).to(device).forced(truth.forcing)
        dtype = next((parameter.dtype for parameter in model.parameters()), torch.float64)
        last = last_seen(scene.seen_in(directory), len(truth.times))
        tables = evaluate(truth, model, evaluation_frames(truth), last, dtype)
        mach = truth.reference.get("mach_turbulent")
        description = definition.describe(truth.scales) | {"coefficients": model.learned_coefficients}
    if "training" in source.description:
        description["training"] = source.description["training"]
    origin, own_errors = trained_on(source, scene.model.path)
    provenance = {**stage_provenance(scene, "train"), "mach_turbulent": mach, "source": origin}
    kept = source.tables | ({"source_a_priori": own_errors} if own_errors else {})
    save_weights(comm, directory / STAGES["train"].file, "model", description, source.weights, provenance,
                 kept | tables)
    errors, beside = tables["a_priori"], []
    if "pressure_gradient_error" in errors:
        beside.append(f"exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f}")
    beside.append(f"on the flow of its training {own_errors['acceleration_error'][-1]:.3f}" if own_errors else
                  f"trained on {', '.join(origin['truths'])}")
    log.info("model: weights of %s; acceleration error %.3f (%s)", source.path, errors["acceleration_error"][-1],
             "; ".join(beside))


def trained_on(source: StoredWeights, path: str) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """The origin of the weights of a source, and the a-priori errors on the flow of the training.

    The origin has `path` and `mach_turbulent` of the run that trained the weights. A source that took its weights from
    another run stores this origin. If the source was trained only on ground truths of other runs, the origin has
    `truths`, their Mach numbers, instead of `mach_turbulent`, and the errors are None.
    """
    origin = source.provenance
    if "source" in origin:
        return origin["source"], source.tables.get("source_a_priori")
    if others_trained_on(origin):
        return {"path": path, "truths": origin["mach_of_truths"]}, None
    return {"path": path, "mach_turbulent": origin.get("mach_turbulent")}, source.tables["a_priori"]
