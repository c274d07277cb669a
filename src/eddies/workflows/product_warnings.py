"""Warnings of a report: products that do not belong together or were made with other settings, and numbers that are not
finite."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from eddies.io.errors import remedy_for
from eddies.io.hdf5 import File, read_attributes, stored_numbers
from eddies.io.provenance import product_provenance
from eddies.pipeline import MAKER_OF, STAGES
from eddies.scene.scene import Scene, stored_scene
from eddies.workflows.learned.source import seen_by, start_within_training
from eddies.workflows.run_directory.work import changed_settings, differences, of_other_settings
from eddies.workflows.variants import steps

Provenance = Mapping[str, Any]

# Columns of a training history with a number in every step. Other columns are NaN in steps that do not compute them.
COLUMNS_OF_ALL_STEPS = "step", "phase", "seconds", "loss", "learning_rate", "gradient_norm"
MOST_NAMED = 4  # largest number of places in a file that a warning names


def doubts(directory: Path, provenance: Mapping[str, Provenance], old: Mapping[Path, Sequence[str]]) -> list[str]:
    """Return a sentence on each reason to doubt the numbers of a run directory, as far as provenance tells.

    `provenance` maps the kind of each product in the directory to the provenance of the product. `old` is the result
    of `old_products`. A sentence begins with the name of a product's file.
    """
    found = [f"{_made(kind, origin)} was made with {of_other_settings(old[path])} than those of the last job; "
             f"{remedy_for(kind, MAKER_OF[kind].file)}, or note that the report shows it as it was made"
             for kind, origin in provenance.items() if (path := directory / MAKER_OF[kind].file) in old]
    return [*found, *mixed_products(provenance), *changed_truths(provenance.get("model", {})),
            *_start_within_training(directory, provenance)]


def _start_within_training(directory: Path, provenance: Mapping[str, Provenance]) -> list[str]:
    """Return a sentence, in a list, if the rollout starts within the training of the model beside it."""
    model, rollout = provenance.get("model"), provenance.get("rollout")
    scene = stored_scene(rollout.get("scene", "")) if model and rollout else None
    found = scene and start_within_training(scene, directory, seen_by(model, directory))
    return [f"{_made('rollout', rollout)}: {found}"] if found else []


def mixed_products(provenance: Mapping[str, Provenance]) -> list[str]:
    """Return a sentence for each product in a run directory that was not made from the products beside it.

    `provenance` maps the kind of each product in the directory to the provenance of the product.
    """
    found = []
    for kind, origin in provenance.items():
        others = {needed: provenance.get(needed) for needed, known in origin.get("made_from", {}).items()
                  if needed not in provenance or provenance[needed].get("id") != known}
        if others:
            named = " and from ".join(_other(needed, origin, present) for needed, present in others.items())
            or_else = ("note that the report compares different flows or models" if any(others.values()) else
                       "restore the missing file")
            found.append(f"{_made(kind, origin)} was made from {named}: "
                         f"{remedy_for(kind, MAKER_OF[kind].file)}, or {or_else}")
    return found


def old_products(scene: Scene, directory: Path) -> dict[Path, list[str]]:
    """Return the products of a run that were made with other settings than `scene`, the scene of its last job.

    The result maps the path of each such product to the settings that differ, as `changed_settings`. A product is left
    out if only the content of files differs: these files may just not be found from the working directory.
    """
    found = {}
    for step in steps(scene, tuple(STAGES), directory):
        for stage in [STAGES[name] for name in step.stages]:
            origin = product_provenance(step.directory / stage.file)
            if origin and (differing := differences(stage, origin, step.scene)):
                found[step.directory / stage.file] = differing
    return found


def changed_truths(origin: Provenance) -> list[str]:
    """Return a sentence for each ground truth of another run that has changed since a model was trained on it.

    `origin` is the provenance of the model. Removed ground truths are skipped.
    """
    now = {path: product_provenance(path).get("id") for path in origin.get("truths", {})}
    return [f"{_made('model', origin)} was trained on {path}, which has changed since then; "
            f"{remedy_for('model', MAKER_OF['model'].file)}, or note that the model has learned from another flow"
            for path, known in origin.get("truths", {}).items() if now[path] not in (None, known)]


def not_finite(file: File, kind: str) -> str:
    """Return a sentence that names the numbers of an open product that are not finite, or an empty text if there are
    none. Only the last frame of a series is read."""
    places = []
    for place, frame, values in stored_numbers(file):
        table, _, column = place.partition("/")
        # Some numbers may be NaN: a training does not compute each of them in every step, and a trial may fail.
        gaps = kind == "step" or kind == "model" and table == "history" and column not in COLUMNS_OF_ALL_STEPS
        # In a ground truth, some scales of an inviscid fluid and the sound speed of an incompressible one are infinite.
        wrong = np.isnan(values) if kind == "ground_truth" else ~np.isfinite(values) & (not gaps)
        if wrong.any():
            row = "" if not wrong.ndim else f", row {int(np.argwhere(wrong)[0, 0])}"
            places.append(place + (row if frame is None else f", frame {frame}"))
    if not places:
        return ""
    more = f" and {len(places) - MOST_NAMED} more" if len(places) > MOST_NAMED else ""
    status = read_attributes(file, "rollout")["status"] if kind == "rollout" else "complete"
    remedy = remedy_for(kind, MAKER_OF[kind].file) if status == "complete" else f"the rollout {status}"
    return f"{MAKER_OF[kind].file} holds numbers that are not finite ({'; '.join(places[:MOST_NAMED])}{more}): {remedy}"


def _made(kind: str, origin: Provenance) -> str:
    return f"{MAKER_OF[kind].file} (made {origin['date']})"


def _other(kind: str, origin: Provenance, present: Provenance | None) -> str:
    """Describe the missing product of this `kind`, from which another product in the directory was made.

    `origin` is the provenance of that other product. `present` is the provenance of the product of this `kind` that the
    directory holds now, or None. If there is one, the text names the settings that changed.
    """
    if present is None:
        return f"a {MAKER_OF[kind].file} that is not here"
    changes = changed_settings(MAKER_OF[kind], origin.get("scene"), present.get("scene"))
    settings = of_other_settings(changes) if changes else "the same settings"
    return f"another {MAKER_OF[kind].file} than the one here, made {present['date']} with {settings}"
