"""What a report must not show without a word: products that do not belong together, numbers that are not finite."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from eddies.io.errors import make_again
from eddies.io.hdf5 import File, read_attributes, stored_numbers
from eddies.io.provenance import product_provenance
from eddies.pipeline import MAKER_OF, STAGES
from eddies.workflows.run_directory.work import changed_settings, of_other_settings

Provenance = Mapping[str, Any]

# Columns of a model's training that every step has; others are NaN where a step had no such number.
OF_EVERY_STEP = "step", "phase", "seconds", "loss", "learning_rate", "gradient_norm"
NAMED = 4  # places that a sentence names


def mixed_products(provenance: Mapping[str, Provenance]) -> list[str]:
    """A sentence for each product that was made from others than lie beside it, or does not say from which.

    Parameters
    ----------
    provenance : of the products of a run directory, by kind.
    """
    found = []
    for kind, origin in provenance.items():
        again = make_again(kind)
        if "made_from" not in origin:
            beside = [STAGES[name].product for name in MAKER_OF[kind].depends_on]
            known = [_made(needed, provenance[needed]) for needed in beside if "id" in provenance.get(needed, {})]
            if known:
                found.append(f"{_made(kind, origin)} does not say what it was made from: whether it belongs to "
                             f"{' and '.join(known)} is not known; {again}")
            continue
        others = {needed: provenance.get(needed) for needed, known in origin["made_from"].items()
                  if needed not in provenance or provenance[needed].get("id") != known}
        if others:
            named = " and from ".join(_other(needed, origin, present) for needed, present in others.items())
            or_else = ("take what is compared as of different flows or models" if any(others.values()) else
                       "bring back what is missing")
            found.append(f"{_made(kind, origin)} was made from {named}: {again}, or {or_else}")
    return found


def changed_truths(origin: Provenance) -> list[str]:
    """A sentence for each ground truth of another run that a model was trained on and that is another now; `origin` is
    the provenance of the model. Nothing is said of what is no longer there."""
    truths = origin.get("truths", {})
    now = {path: product_provenance(path).get("id") for path in truths}
    return [f"{_made('model', origin)} was trained on another {path} than is there now; {make_again('model')}, or take "
            "it as of another flow" for path, known in truths.items() if now[path] not in (None, known)]


def not_finite(file: File, kind: str) -> str:
    """A sentence on the numbers of an open product that are not finite, or ""; of series the last frame counts."""
    places = []
    for place, frame, values in stored_numbers(file):
        wrong = _wrong(kind, place, values)
        if wrong.any():
            row = "" if not wrong.ndim else f", row {int(np.argwhere(wrong)[0, 0])}"
            places.append(place + (row if frame is None else f", frame {frame}"))
    if not places:
        return ""
    more = f" and {len(places) - NAMED} more" if len(places) > NAMED else ""
    status = read_attributes(file, "rollout")["status"] if kind == "rollout" else "complete"
    remedy = make_again(kind) if status == "complete" else f"the rollout {status}"
    return f"{MAKER_OF[kind].file} holds numbers that are not finite ({'; '.join(places[:NAMED])}{more}): {remedy}"


def _wrong(kind: str, place: str, values: np.ndarray) -> np.ndarray:
    """Which values are not finite and should be."""
    if kind == "ground_truth":
        return np.isnan(values)  # scales without viscosity and the sound speed of an incompressible fluid are infinite
    table, _, column = place.partition("/")
    gaps = kind == "step" or kind == "model" and table == "history" and column not in OF_EVERY_STEP
    return ~np.isfinite(values) & (not gaps)


def _made(kind: str, origin: Provenance) -> str:
    return f"{MAKER_OF[kind].file} (made {origin['date']})"


def _other(kind: str, origin: Provenance, present: Provenance | None) -> str:
    """The product that one was made from, beside what is here in its place."""
    if present is None:
        return f"a {MAKER_OF[kind].file} that is not here"
    changes = changed_settings(MAKER_OF[kind], origin.get("scene"), present.get("scene"))
    settings = of_other_settings(changes) if changes else "the same settings"
    return f"another {MAKER_OF[kind].file} than the one here, made {present['date']} with {settings}"
