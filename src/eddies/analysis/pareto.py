"""Error against cost: the Pareto front, and sentences that say where a model is worth its cost."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Method = Mapping[str, Any]  # `label`, a cost and errors by key, None where unknown; KEY_spread: standard deviations


def pareto_front(cost: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Indices of the points (n,) that no other one dominates, from the cheapest on; points with NaN are left out.

    A point dominates another if neither its cost nor its error is larger and one of them is smaller.
    """
    cost, error = np.asarray(cost, float), np.asarray(error, float)
    measured = np.flatnonzero(np.isfinite(cost) & np.isfinite(error))
    front = []
    for index in measured:
        no_worse = (cost[measured] <= cost[index]) & (error[measured] <= error[index])
        better = (cost[measured] < cost[index]) | (error[measured] < error[index])
        if not np.any(no_worse & better):
            front.append(index)
    return np.array(sorted(front, key=lambda index: (cost[index], error[index])), dtype=int)


def verdict(model: Method, others: Sequence[Method], cost: str, measures: Mapping[str, str]) -> list[str]:
    """Two sentences: the measures in which a method is worth its cost, and the other measures.

    It is worth its cost if no other method that costs no more is as accurate. Errors that differ by less than the
    larger spread over realisations are equal. A method without a number counts as beaten.

    Parameters
    ----------
    cost : key of the cost. measures : keys of the errors, with their names in words.
    """
    if not others:
        return ["No other method was run."]
    worth, not_worth = [], []
    for key, words in measures.items():
        if None in (model[key], model[cost]):
            not_worth.append(f"{words} (no number)")
            continue
        measured = [row for row in others if None not in (row[key], row[cost])]
        rivals = [row for row in measured if row[cost] <= model[cost] and not _worse(row, model, key)]
        beaten = sum(row not in measured or _worse(row, model, key) for row in others)
        score = f"{words} ({model[key]:.3g}, {beaten} of {len(others)} others beaten; "
        if rivals:
            named = ", ".join(_compared(row, model, key, cost) for row in rivals)
            not_worth.append(f"{score}as accurate and no slower: {named})")
        elif measured:
            best = min(measured, key=lambda row: row[key])
            worth.append(f"{score}the best of them: {_compared(best, model, key, cost)})")
        else:
            worth.append(f"{score}none of them has a number)")
    name = model["label"]
    return [f"{name} is worth its cost in {', '.join(worth)}: nothing that is as fast is as accurate." if worth else
            f"{name} is worth its cost in no measure.",
            f"It is not in {', '.join(not_worth)}." if not_worth else
            "There is no measure in which another method is as accurate and no slower."]


def cheapest_grid(model: Method, grids: Sequence[Method], cost: str, times: Mapping[str, str]) -> str:
    """A sentence that names the cheapest grid whose velocity error is at most the model's at all `times`.

    `times` are keys of the errors, with the times in words. Means over realisations are compared. "" if the model has
    not all numbers.
    """
    def errors(row: Method) -> str:
        return ", ".join(f"{row[key]:.3g}" for key in times)

    if not times or None in [model[key] for key in (cost, *times)]:
        return ""
    limit = f"keeps the velocity error after {' and '.join(times.values())} at or below that of {model['label']}"
    kept = [row for row in grids if None not in [row[key] for key in (cost, *times)]
            and all(row[key] <= model[key] for key in times)]
    if not kept:
        return f"No grid {limit} ({errors(model)})."
    best = min(kept, key=lambda row: row[cost])
    return (f"The cheapest grid that {limit} ({errors(model)}) is {best['label']} ({errors(best)}), at "
            f"{best[cost] / model[cost]:.2g} of its cost.")


def _worse(row: Method, model: Method, key: str) -> bool:
    """Whether the error of a row is larger, by more than either spread."""
    spread = max(one.get(f"{key}_spread") or 0.0 for one in (row, model))
    return row[key] > model[key] + spread


def _compared(row: Method, model: Method, key: str, cost: str) -> str:
    return f"{row['label']}, {row[key]:.3g} in {row[cost] / model[cost]:.2g} of its time"
