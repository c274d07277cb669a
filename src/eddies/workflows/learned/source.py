"""The definition of a model in a scene, its comparison with the trained model of another run, and the flows that this
model has seen.

A dict of seen flows maps the `flow_fingerprint` of each flow to the end of the training window, in turnovers after the
release of the tracers. A model stores it in its provenance as `seen`. The module does not need torch.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import MISSING, asdict, dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from eddies.import_path import short_name
from eddies.io.hdf5 import ProductError
from eddies.io.provenance import others_trained_on, product_provenance
from eddies.io.weights import StoredWeights, load_weights
from eddies.parallel.communicator import Comm
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.pipeline import STAGES
from eddies.scene.rules import quoted
from eddies.scene.scene import Model, Scene, SceneError, Tracers, stored_scene
from eddies.scene.sections import NEIGHBORS
from eddies.workflows.run_directory.fingerprints import flow_fingerprint

# Keys of terms in version 1.0 that later versions lack, with the fixed values that later versions use.
FORMER = {"force": True, "kernel": "cubic-spline", "background": 0.25}


@dataclass(frozen=True)
class ModelDefinition:
    """The parts of a scene that define a model. With the scales of a flow they give the model for that flow.

    Parameters
    ----------
    model : [model], the terms and their settings; None if the scene has none.
    tracers : [tracers], particles and filter.
    neighbors : mean number of particles within the radius of interaction; without a key in [model], that of [kernel].
    seed : seed of the initial parameters.
    """

    model: Model
    tracers: Tracers
    neighbors: float
    seed: int

    @classmethod
    def of(cls, scene: Scene) -> ModelDefinition:
        """Return the definition in a scene."""
        given = [each.neighbors for each in (scene.model, scene.kernel) if each is not None]
        return cls(scene.model, scene.tracers, next(filter(None, given), NEIGHBORS), scene.seed)

    @property
    def radius(self) -> float:
        """Radius of interaction of pairs."""
        return self.tracers.radius_of(self.neighbors)

    def units(self, scales: ReferenceScales) -> FlowUnits:
        """Return the units for a flow with these scales. The radius of interaction is proportional to the mean particle
        spacing."""
        return FlowUnits(scales, self.radius * (scales.spacing / self.tracers.spacing), self.neighbors, self.seed)

    def describe(self, scales: ReferenceScales) -> dict[str, Any]:
        """Return the description that is stored with the weights: the terms with their settings, the scales, and the
        number of neighbours if a term reads pairs. It can be written as JSON."""
        settings = {term: asdict(self.model.settings[short_name(term)]) for term in self.model.terms}
        neighbors = {"neighbors": self.neighbors} if "pairs" in self.model.reads else {}
        return {"terms": settings, "scales": scales.to_dict(), **neighbors}

    def differences(self, description: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
        """Yield key, own value and stored value, as TOML, for each difference from a stored description.

        Classes are compared by name, so that reading a file never imports a class that it names.
        """
        trained_terms = description["terms"]
        if list(self.model.terms) != list(trained_terms):
            yield "[model] terms", quoted(self.model.terms), quoted(list(trained_terms))
            return
        for term, trained in trained_terms.items():
            name, settings = short_name(term), self.model.settings[short_name(term)]
            wanted = json.loads(json.dumps(asdict(settings)))
            # If an older description lacks a key, it means the default of this key.
            stored = {field.name: field.default for field in fields(settings) if field.default is not MISSING}
            stored = json.loads(json.dumps(stored)) | trained
            for key in wanted.keys() | stored.keys():
                if (value := wanted.get(key, FORMER.get(key))) != stored.get(key):
                    yield f"[model.{name}] {key}", quoted(value), quoted(stored.get(key))
        if "pairs" in self.model.reads and self.neighbors != description["neighbors"]:
            yield "[model] neighbors", quoted(self.neighbors), quoted(description["neighbors"])
        scales = description["scales"]
        width = scales["filter_width"] / scales["spacing"] * self.tracers.spacing
        if not math.isclose(self.tracers.filter_width, width, rel_tol=1e-6):
            yield "[tracers] filter_width", f"{self.tracers.filter_width:.9g}", f"{width:.9g}"


def read_source(name: str, definition: ModelDefinition, comm: Comm) -> StoredWeights:
    """Read the trained model at [model] path; all ranks call it. `name` is the name of the scene, for errors.

    Raises:
        ProductError: the file is missing or damaged.
        SceneError: the model and the scene differ in terms, settings, neighbours, or filter width in spacings.
    """
    path = definition.model.weights_file
    try:
        source = load_weights(comm, path, "model")
    except ProductError as error:
        raise ProductError(f"{name}: [model] path = {quoted(definition.model.path)}: {error}") from None
    for key, wanted, trained in definition.differences(source.description):
        raise SceneError(f"{name}: {key} = {wanted}, but {path} was trained with {trained}; set "
                         f"{key} = {trained}, or give another [model] path")
    return source


def trained_on(source: StoredWeights, path: str) -> tuple[dict[str, Any], dict[str, np.ndarray] | None]:
    """Return the origin of the weights, and the a-priori errors on the flow on which they were trained.

    The origin holds `path` and `mach_turbulent` of the run that trained the weights. If `source` itself took its
    weights from another run, both results are those that `source` stores; the errors are None if it stores none. If the
    weights were trained only on ground truths of other runs, the origin holds `path` and `truths`, the Mach numbers of
    these ground truths, and the errors are None.
    """
    origin = source.provenance
    if "source" in origin:
        return origin["source"], source.tables.get("source_a_priori")
    if others_trained_on(origin):
        return {"path": path, "truths": origin["mach_of_truths"]}, None
    return {"path": path, "mach_turbulent": origin.get("mach_turbulent")}, source.tables["a_priori"]


# ---- seen flows


def seen_flows(scene: Scene, directory: Path) -> dict[str, float]:
    """Return the flows that the training of a scene sees; empty if it trains no model. One rank calls it.

    `directory` is that of the scene's own ground truth, which need not exist. Ground truths of other runs that cannot
    be read are left out.
    """
    training, own = scene.own_training, (directory / STAGES["dns"].file).resolve()
    if training is None or scene.model is None or not training.steps and training.horizons is None:
        return {}
    used = [scene if path.resolve() == own else stored_scene(product_provenance(path).get("scene", ""))
            for path in training.truth_files or (own,)]
    return {flow_fingerprint(each): training.window * each.tracers.turnovers
            for each in used if each is not None and each.tracers is not None}


def seen_by(origin: Mapping[str, Any], directory: Path) -> dict[str, float]:
    """Return the flows that a stored model has seen; one rank calls it. `origin` is the provenance of the model, and
    `directory` is where it is stored.

    Earlier versions did not store them. They then follow from the scene of the training.
    """
    if "seen" in origin:
        return origin["seen"]
    scene = stored_scene(origin.get("scene", ""))
    return {} if scene is None else seen_flows(scene, directory)


def start_within_training(scene: Scene, directory: Path, seen: Mapping[str, float]) -> str | None:
    """Return a sentence if the rollout of a scene starts within the training of its model, else None.

    `directory` is that of the ground truth, and `seen` are the flows that the model has seen.
    """
    end = seen.get(flow_fingerprint(scene)) if scene.needs_model else None
    if end is None:
        return None
    length, given = scene.tracers.turnovers, scene.simulation.start
    start = (scene.seen_in(directory) if given is None else given) * length
    if start >= end * (1 - 1e-9):
        return None
    remedy = f"set start to {end / length:.3g} or more" if end < length else "raise [tracers] turnovers and start"
    return (f"[simulation] start{'' if given is None else f' = {given:g}'}: the rollout starts {start:.3g} turnovers "
            f"after the release of the tracers, but its model was trained on this very flow up to {end:.3g} "
            f"turnovers, so its errors are not those on an unseen flow; {remedy}, or take weights of another flow")
