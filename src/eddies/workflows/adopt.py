"""A model trained on another flow: its weights with the scales of this flow, tested a priori."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.hdf5 import open_product
from eddies.io.weights import save_weights
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.pair_forces import PairModel
from eddies.scene import BOX_LENGTH, Scene
from eddies.workflows.a_priori import evaluate, evaluation_frames
from eddies.workflows.closures import density_closure
from eddies.workflows.devices import prepare_torch
from eddies.workflows.model_source import ModelSource, read_source
from eddies.workflows.trained_model import model_from
from eddies.workflows.truth import GroundTruth

log = logging.getLogger("eddies")


def run(scene: Scene, comm, directory: str | Path) -> None:
    """Write model.h5 with the weights that [model] path names, instead of training; all ranks call it.

    The network works in units of the flow (Eq. 4), so only the scales and the support are this flow's. The tables are
    the source's, but for the a-priori tests: those of this flow, beside `source_a_priori`, those of the flow on which
    the weights were trained.
    """
    device, source = prepare_torch(scene.device, comm), read_source(scene, comm)
    slab = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.particles_per_side)
    with open_product(comm, Path(directory) / "ground_truth.h5", "ground_truth") as file:
        truth = GroundTruth(file, slab)
        model = adopted_model(scene, source, truth).to(device)
        dtype = next(model.parameters()).dtype
        closure = density_closure(model, slab, dtype)
        last = truth.last_frame_seen(scene.seen) if scene.seen else 0
        tables = evaluate(truth, model, closure, evaluation_frames(truth), last, dtype, device)
        mach = truth.reference["mach_turbulent"]
    origin, own_errors = trained_on(scene, source)
    provenance = {"scene": scene.to_toml(), "fingerprint": scene.fingerprint("train"), "mach_turbulent": mach,
                  "source": origin}
    kept = source.tables | {"source_a_priori": own_errors}
    save_weights(comm, Path(directory) / "model.h5", "model", model.state_description(), source.weights, provenance,
                 kept | tables)
    errors = tables["a_priori"]
    log.info("model: weights of %s; acceleration error %.3f (exact filtered pressure gradient %.3f; on its own flow "
             "%.3f)", source.path, errors["acceleration_error"][-1], errors["pressure_gradient_error"][-1],
             own_errors["acceleration_error"][-1])


def trained_on(scene: Scene, source: ModelSource) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Path and Mach number of the run where weights were trained, and errors there; not of one that adopted them."""
    direct = {"path": scene.model.path, "mach_turbulent": source.provenance.get("mach_turbulent")}
    return (source.provenance.get("source", direct),
            source.tables.get("source_a_priori", source.tables["a_priori"]))


def adopted_model(scene: Scene, source: ModelSource, truth: GroundTruth) -> PairModel:
    """The source's model with the scales of a ground truth and the support of the scene's kernel."""
    support = scene.kernel.support(scene.tracers.particles)
    description = source.description | {"scales": truth.scales.to_dict(), "support": support}
    return model_from(description, source.weights, source.path)
