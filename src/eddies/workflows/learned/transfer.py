"""A model trained on another flow: its weights with the scales of this flow, tested a priori."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.io.hdf5 import open_product
from eddies.io.weights import save_weights
from eddies.parallel.communicator import Comm
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import prepare_torch
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.ground_truth.truth import GroundTruth
from eddies.workflows.learned.a_priori import evaluate, evaluation_frames
from eddies.workflows.learned.description import describe
from eddies.workflows.learned.model import with_weights
from eddies.workflows.learned.source import ModelSource, read_source

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, directory: str | Path) -> None:
    """Write model.h5 with the weights that [model] path names, instead of training; all ranks call it.

    Terms work in units of the flow (Eq. 4), so only the scales and the support are this flow's. The tables are
    the source's, but for the a-priori tests: those of this flow, beside `source_a_priori`, those of the flow on which
    the weights were trained.
    """
    device, source = prepare_torch(scene.device, comm), read_source(scene, comm)
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes)
    with open_product(comm, Path(directory) / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, slab)
        model = with_weights(scene, source.description, source.weights, source.path, truth.scales).to(device)
        model = model.forced(truth.forcing)
        dtype = next((parameter.dtype for parameter in model.parameters()), torch.float64)
        last = truth.last_frame_seen(scene.seen_in(Path(directory)))
        tables = evaluate(truth, model, evaluation_frames(truth), last, dtype, device)
        mach, description = truth.reference.get("mach_turbulent"), describe(scene, truth.scales)
    origin, own_errors = trained_on(scene, source)
    provenance = {**scene.provenance("train"), "mach_turbulent": mach, "source": origin}
    kept = source.tables | {"source_a_priori": own_errors}
    save_weights(comm, Path(directory) / "model.h5", "model", description, source.weights, provenance, kept | tables)
    errors = tables["a_priori"]
    beside = (f"exact filtered pressure gradient {errors['pressure_gradient_error'][-1]:.3f}; "
              if "pressure_gradient_error" in errors else "")
    log.info("model: weights of %s; acceleration error %.3f (%son its own flow %.3f)", source.path,
             errors["acceleration_error"][-1], beside, own_errors["acceleration_error"][-1])


def trained_on(scene: Scene, source: ModelSource) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Path and Mach number of the run where weights were trained, and errors there; not of one that took them."""
    direct = {"path": scene.model.path, "mach_turbulent": source.provenance.get("mach_turbulent")}
    return (source.provenance.get("source", direct),
            source.tables.get("source_a_priori", source.tables["a_priori"]))
