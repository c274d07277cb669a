"""Trained weights of another run, checked against the form of the model that a scene asks for."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.hdf5 import ProductError, open_product, read_provenance
from eddies.io.weights import load_tables, load_weights
from eddies.scene import Scene, SceneError
from eddies.scene_values import quoted


@dataclass(frozen=True)
class ModelSource:
    """What a model.h5 holds: description, weights and tables by name, and where it comes from."""

    path: Path
    description: dict[str, Any]
    weights: dict[str, np.ndarray]
    tables: dict[str, dict[str, np.ndarray]]
    provenance: dict[str, Any]


def read_source(scene: Scene, comm) -> ModelSource:
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


def differences(scene: Scene, description: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Keys in which a scene differs from the description of a trained model, with both values, as TOML."""
    for field in fields(scene.model):
        # A key that is younger than the file had its default when the file was written.
        wanted, trained = getattr(scene.model, field.name), description.get(field.name, field.default)
        if field.name != "path" and json.dumps(wanted) != json.dumps(trained):
            yield f"[model] {field.name}", quoted(wanted), quoted(trained)
    if scene.kernel.neighbors != description["neighbors"]:
        yield "[kernel] neighbors", quoted(scene.kernel.neighbors), quoted(description["neighbors"])
    scales, tracers = description["scales"], scene.tracers
    width = scales["length"] / scales["spacing"] * tracers.spacing
    if not math.isclose(tracers.width, width, rel_tol=1e-6):
        yield "[tracers] filter_width", f"{tracers.width:.9g}", f"{width:.9g}"
