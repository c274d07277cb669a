"""A model trained on another flow: its weights with the scales of this flow, tested a priori."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.hdf5 import open_product
from eddies.io.provenance import others_trained_on
from eddies.io.weights import save_weights
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import prepare_torch
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.model import with_weights
from eddies.workflows.learned.source import ModelSource, describe, read_source
from eddies.workflows.run_directory.fingerprints import stage_provenance

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path) -> None:
    """Write model.h5 with the weights that [model] path names, instead of training; all ranks call it.

    Terms work in units of the flow (Eq. 4), so only the scales and the support are this flow's. The tables are
    the source's, but for the a-priori tests: those of this flow, beside `source_a_priori`, those of the flow on which
    the weights were trained, if the source tested them there. The cost of training is what the source has stored.
    """
    device, source = prepare_torch(scene.device, comm), read_source(scene, comm)
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)
    with open_product(comm, Path(directory) / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, slab)
        model = with_weights(scene, comm, source.description, source.weights, source.path, truth.scales).to(device)
        model = model.forced(truth.forcing)
        dtype = next((parameter.dtype for parameter in model.parameters()), torch.float64)
        last = truth.last_frame_seen(scene.seen_in(Path(directory)))
        tables = evaluate(truth, model, evaluation_frames(truth), last, dtype, device)
        mach = truth.reference.get("mach_turbulent")
        description = describe(scene, truth.scales) | {"coefficients": model.learned_coefficients}
    if "training" in source.description:
        description["training"] = source.description["training"]
    origin, own_errors = trained_on(scene, source)
    provenance = {**stage_provenance(scene, "train"), "mach_turbulent": mach, "source": origin}
    kept = source.tables | ({"source_a_priori": own_errors} if own_errors else {})
    save_weights(comm, Path(directory) / "model.h5", "model", description, source.weights, provenance, kept | tables)
    errors, beside = tables["a_priori"], []
    if "pressure_gradient_error" in errors:
        beside.append(f"exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f}")
    beside.append(f"on its own flow {own_errors['acceleration_error'][-1]:.3f}" if own_errors else
                  f"trained on {', '.join(origin['truths'])}")
    log.info("model: weights of %s; acceleration error %.3f (%s)", source.path, errors["acceleration_error"][-1],
             "; ".join(beside))


def trained_on(scene: Scene, source: ModelSource) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """Path and Mach number of the run where weights were trained, and errors there; not of one that took them.

    Where that run trained on ground truths of others alone, its own flow was none of them: then these by path with
    their Mach numbers, as `truths`, in place of its own, and no errors.
    """
    origin, path = source.provenance, scene.model.path
    if "source" in origin:
        return origin["source"], source.tables.get("source_a_priori")
    if others_trained_on(origin):
        return {"path": path, "truths": origin["mach_of_truths"]}, None
    return {"path": path, "mach_turbulent": origin.get("mach_turbulent")}, source.tables["a_priori"]
