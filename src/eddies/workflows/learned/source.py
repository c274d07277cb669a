"""Trained weights of another run, checked against the form of the model that a scene asks for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.hdf5 import ProductError, open_product
from eddies.io.provenance import read_provenance
from eddies.io.weights import load_tables, load_weights
from eddies.parallel.communicator import Comm
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene, SceneError
from eddies.workflows.learned.description import differences


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
