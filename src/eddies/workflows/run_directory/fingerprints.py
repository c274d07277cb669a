"""How products depend on the scene: fingerprints of stages, and the provenance that is stored in a product."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

from eddies.import_path import origins
from eddies.io.file_patterns import FileVersion, file_versions, short_names
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, Tracers
from eddies.scene.sections import SET_KEYS
from eddies.scene.values import import_paths


def stage_fingerprint(scene: Scene, stage: str, without: Sequence[str] = ()) -> str:
    """Return the SHA-256 checksum of all inputs of a stage's product. `without` names keys to leave out, such as
    `Stage.duration`.

    The inputs are the settings of the stage and of the stages on which it depends, the content of the files from which
    the flow, the weights and the step come, the source code of the user's classes, and the fingerprints of ground
    truths of other runs.
    """
    training, simulation = scene.training, scene.simulation
    settings: dict[str, Any] = asdict(scene) | {
        "window": scene.window, "start": _digest(scene.tracks.file if scene.tracks else scene.initial.file),
        "weights": _digest(scene.model.weights_file if scene.model else None),
        "points": _digest(scene.reconstruction.points_file if scene.reconstruction else None),
        "truths": _fingerprints(training.truth_files if training else ()),
        "found_step": _digest(simulation.step_file if simulation else None),
        "confirming": _fingerprints(simulation.confirming_files if simulation else ())}
    if scene.sets:  # each set has its own SET_KEYS; all sets share the other keys
        sets = settings["tracers"].pop("sets")
        settings["tracers"] = {key: value for key, value in settings["tracers"].items() if key not in SET_KEYS} | {
            "sets": {name: {key: sets[name][key] for key in SET_KEYS} for name in sorted(sets)}}
    # The content of these files counts, not their paths.
    for content, section, key in (("start", "tracks" if scene.tracks else "initial", "path"),
                                  ("weights", "model", "path"), ("points", "reconstruction", "points"),
                                  ("found_step", "simulation", "step_from")):
        if settings[content] is not None:
            del settings[section][key]
    if simulation is not None:
        del settings["simulation"]["confirmed_on"]
    settings |= {f"own_{name}": origins(path for key, path in import_paths(scene) if key.startswith(f"{name}."))
                 for name in ("flow", "initial", "model", "simulation")}  # the sections that may name users' classes
    of_these = {*STAGES[stage].depends_on, stage} & {*scene.stages}
    read = [[key, _without(settings[key], key, (*each.but, *without))]
            for each in STAGES.values() if each.name in of_these for key in each.reads]
    return hashlib.sha256(json.dumps(read).encode()).hexdigest()


def flow_fingerprint(scene: Scene) -> str:
    """Return the checksum of all that determines the flow of a ground truth after the release of its tracers.

    Ground truths with the same checksum hold the same realisation, whatever their duration and their tracers. A seed
    that the flow does not depend on does not count.
    """
    if scene.tracks is not None or not scene.initial.flow.seeded:
        scene = replace(scene.without_variants, seed=0)
    tracers = [f"tracers.{key.name}" for key in fields(Tracers) if key.name != "forced"]
    return stage_fingerprint(scene, "dns", (*tracers, "time.duration"))


def set_files(scene: Scene) -> dict[Path, str]:
    """Return the fingerprint of each tracer set's ground truth. The keys are the paths of these files, relative to the
    run directory."""
    return {Path(name) / STAGES["dns"].file: stage_fingerprint(own, "dns") for name, own in scene.tracer_sets.items()}


def stage_provenance(scene: Scene, stage: str) -> dict[str, Any]:
    """Return what the product of a stage stores about the scene.

    This is the text of the scene, the fingerprint of the stage, the kinds of the products from which the product is
    made and, if the scene names classes of the user, their origins.
    """
    foreign = {"foreign": origins(scene.foreign)} if scene.foreign else {}
    return {"scene": scene.to_toml(), "fingerprint": stage_fingerprint(scene, stage),
            "made_from": [each.product for each in scene.inputs(stage)], **foreign}


def _without(value: Any, section: str, keys: Sequence[str]) -> Any:
    """Return a section without `keys`, which have the form "section.key". A value that is not a section is returned
    unchanged."""
    if not isinstance(value, dict):
        return value
    return {key: each for key, each in value.items() if f"{section}.{key}" not in keys}


def _fingerprints(paths: Sequence[Path]) -> list[str | None]:
    """Return the fingerprints stored in ground truths; None for a missing file. A checksum of the whole files would
    take too long."""
    if not paths:
        return []
    from eddies.io.provenance import product_fingerprint  # imports h5py and mpi4py
    return [product_fingerprint(path) for path in paths]


def _digest(path: str | Path | None) -> str | None:
    """Return the SHA-256 checksum of a file's content; None if there is no such file. That of a series of files, which
    a path with * names, is of their names too, because these may give the order."""
    versions = file_versions(path) if path is not None else ()
    return _digest_of_versions(versions) if versions else None


@lru_cache(maxsize=4)  # the files may be large, and a run asks several times
def _digest_of_versions(versions: tuple[FileVersion, ...]) -> str:
    files, digests = [path for path, *_ in versions], {}
    for path, name in zip(files, short_names(files)):
        with open(path, "rb") as file:
            digests[name] = hashlib.file_digest(file, "sha256").hexdigest()
    if len(digests) == 1:
        return digests[name]
    return hashlib.sha256(json.dumps(digests).encode()).hexdigest()
