"""What is stored of a model beside its weights, and how a scene differs from it; known without torch."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from eddies.import_path import short_name
from eddies.particles.reference_scales import ReferenceScales
from eddies.scene.rules import quoted
from eddies.scene.scene import Scene


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
        name = short_name(term)
        wanted = json.loads(json.dumps(asdict(scene.model.settings[name])))
        for key in wanted.keys() | trained.keys():
            if wanted.get(key, FORMER.get(key)) != trained.get(key):
                yield f"[model.{name}] {key}", quoted(wanted.get(key)), quoted(trained.get(key))
    if "pairs" in scene.model.reads and scene.neighbors != description["neighbors"]:
        yield "[model] neighbors", quoted(scene.neighbors), quoted(description["neighbors"])
    scales, tracers = description["scales"], scene.tracers
    width = scales["filter_width"] / scales["spacing"] * tracers.spacing
    if not math.isclose(tracers.filter_width, width, rel_tol=1e-6):
        yield "[tracers] filter_width", f"{tracers.filter_width:.9g}", f"{width:.9g}"
