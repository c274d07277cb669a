"""The flows that a model was trained on, and rollouts that start within the times of its training.

A dict of seen flows maps the `flow_fingerprint` of each flow to the end of the training window, in turnovers after the
release of the tracers. A model stores it in its provenance as `seen`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from eddies.io.provenance import product_provenance
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, stored_scene
from eddies.workflows.run_directory.fingerprints import flow_fingerprint


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
