"""The model of a scene: as it is built, and as it is read from a file with what is stored beside its weights."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from eddies.composition import short_name
from eddies.io.hdf5 import ProductError, open_product, read_table
from eddies.io.weights import load_weights
from eddies.particles.feature_range import FeatureRange
from eddies.particles.flow_units import FlowUnits
from eddies.particles.model import LagrangianModel, build_model
from eddies.particles.reference_scales import ReferenceScales
from eddies.scene import Scene, SceneError
from eddies.scene_rules import quoted

log = logging.getLogger("eddies")


def scene_model(scene: Scene, scales: ReferenceScales) -> LagrangianModel:
    """The terms of a scene with initial parameters, for a flow of these scales.

    Raises SceneError where a class of the user's is no term, or cannot be made.
    """
    flow = FlowUnits(scales, scene.kernel.support(scene.tracers.particles), scene.kernel.neighbors, scene.seed)
    try:
        return build_model(scene.model.settings, scene.model.terms, flow)
    except SceneError as error:
        raise SceneError(f"[model] terms: {error}") from None


def describe(scene: Scene, scales: ReferenceScales) -> dict[str, Any]:
    """What is stored with the weights of a scene's model, ready for JSON: the terms with their settings, and the
    flow."""
    settings = {term: asdict(scene.model.settings[short_name(term)]) for term in scene.model.terms}
    return {"terms": settings, "scales": scales.to_dict(), "neighbors": scene.kernel.neighbors}


def differences(scene: Scene, description: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Keys in which a scene differs from the description of a trained model, with both values, as TOML.

    Classes are compared by their names: none is imported because a file names it.
    """
    trained_terms = description["terms"]
    if list(scene.model.terms) != list(trained_terms):
        yield "[model] terms", quoted(scene.model.terms), quoted(list(trained_terms))
        return
    for term, trained in trained_terms.items():
        name = short_name(term)
        wanted = json.loads(json.dumps(asdict(scene.model.settings[name])))
        for key in wanted.keys() | trained.keys():
            if wanted.get(key) != trained.get(key):
                yield f"[model.{name}] {key}", quoted(wanted.get(key)), quoted(trained.get(key))
    if scene.kernel.neighbors != description["neighbors"]:
        yield "[kernel] neighbors", quoted(scene.kernel.neighbors), quoted(description["neighbors"])
    scales, tracers = description["scales"], scene.tracers
    width = scales["length"] / scales["spacing"] * tracers.spacing
    if not math.isclose(tracers.width, width, rel_tol=1e-6):
        yield "[tracers] filter_width", f"{tracers.width:.9g}", f"{width:.9g}"


def load_model(scene: Scene, comm, path: str | Path, scales: ReferenceScales) -> LagrangianModel:
    """The scene's model with the weights of a file, for a flow of these scales; all ranks call it.

    Raises ProductError as `load_weights`, and where the file holds weights of another model.
    """
    return with_weights(scene, *load_weights(comm, path, "model"), path, scales)


def with_weights(scene: Scene, description: Mapping[str, Any], weights: Mapping[str, np.ndarray], path: str | Path,
                 scales: ReferenceScales) -> LagrangianModel:
    """The scene's model with weights that were stored with a description, in their precision."""
    for key, wanted, trained in differences(scene, description):
        raise ProductError(f"{path}: was trained with {key} = {trained}, and the scene has {wanted}; run "
                           "`eddies train` again, or set the key to that")
    model = scene_model(scene, scales)
    expected = {name: tuple(tensor.shape) for name, tensor in model.state_dict().items()}
    if expected != {name: tensor.shape for name, tensor in weights.items()}:
        raise ProductError(f"{path}: its terms have other parameters now than when this was written; run "
                           "`eddies train` again")
    precision = next((tensor.dtype.name for tensor in weights.values()), "float64")
    model.to(getattr(torch, precision))
    model.load_state_dict({name: torch.from_numpy(np.asarray(tensor)) for name, tensor in weights.items()})
    return model


def load_feature_range(comm, path: str | Path) -> FeatureRange:
    """The range of what the networks of a file were given in training."""
    with open_product(comm, path, "model") as file:
        return FeatureRange(**read_table(file, "feature_range"))
