"""What is stored of a model beside its weights, how a scene differs from it, and the trained weights of another run
with it; known without torch."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from eddies.import_path import short_name
from eddies.io.hdf5 import ProductError, open_product
from eddies.io.provenance import read_provenance
from eddies.io.weights import load_tables, load_weights
from eddies.parallel.communicator import Comm
from eddies.particles.flow_units import ReferenceScales
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene, SceneError

# Keys of terms in version 1.0, with the values at which they are fixed now.
FORMER = {"force": True, "kernel": "cubic-spline", "background": 0.25}


def describe(scene: Scene, scales: ReferenceScales) -> dict[str, Any]:
    """What is stored with the weights of a scene's model, ready for JSON: the terms with their settings, and the
    flow."""
    settings = {term: asdict(scene.model.settings[short_name(term)]) for term in scene.model.terms}
    neighbors = {"neighbors": scene.neighbors} if "pairs" in scene.model.reads else {}
    return {"terms": settings, "scales": scales.to_dict(), **neighbors}


def differences(scene: Scene, description: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Keys in which a scene differs from the description of a trained model, with both values, as TOML.

    Classes are compared by their names: none is imported because a file names it.
    """
    trained_terms = description["terms"]
    if list(scene.model.terms) != list(trained_terms):
        yield "[model] terms", quoted(scene.model.terms), quoted(list(trained_terms))
        return
    for term, trained in trained_terms.items():
        name, settings = short_name(term), scene.model.settings[short_name(term)]
        wanted = json.loads(json.dumps(asdict(settings)))
        # A model that was trained before there was a key has its default.
        then = {field.name: field.default for field in fields(settings) if field.default is not MISSING}
        then = json.loads(json.dumps(then)) | trained
        for key in wanted.keys() | then.keys():
            if (value := wanted.get(key, FORMER.get(key))) != then.get(key):
                yield f"[model.{name}] {key}", quoted(value), quoted(then.get(key))
    if "pairs" in scene.model.reads and scene.neighbors != description["neighbors"]:
        yield "[model] neighbors", quoted(scene.neighbors), quoted(description["neighbors"])
    scales, tracers = description["scales"], scene.tracers
    width = scales["filter_width"] / scales["spacing"] * tracers.spacing
    if not math.isclose(tracers.filter_width, width, rel_tol=1e-6):
        yield "[tracers] filter_width", f"{tracers.filter_width:.9g}", f"{width:.9g}"


@dataclass(frozen=True)
class ModelSource:
    """What a model.h5 holds: description, weights and tables by name, and where it comes from."""

    path: Path
    description: dict[str, Any]
    weights: dict[str, np.ndarray]
    tables: dict[str, dict[str, np.ndarray]]
    provenance: dict[str, Any]


def read_source(scene: Scene, comm: Comm) -> ModelSource:
    """The trained model that [model] path names; all ranks call it.

    Raises:
        ProductError: there is none, or it is damaged.
        SceneError: it has another form, or other neighbourhoods in units of the filter width, than the scene's.
    """
    path = scene.model.weights_file
    try:
        description, weights = load_weights(comm, path, "model")
        with open_product(comm, path, "model") as file:
            provenance = read_provenance(file)
    except ProductError as error:
        raise ProductError(f"{scene.name}: [model] path = {quoted(scene.model.path)}: {error}") from None
    for key, wanted, trained in differences(scene, description):
        raise SceneError(f"{scene.name}: {key} = {wanted}, but {path} was trained with {trained}; set it to "
                         "that, or give another [model] path")
    return ModelSource(path, description, weights, load_tables(path), provenance)
