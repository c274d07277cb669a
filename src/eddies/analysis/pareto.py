"""Error against cost: what nothing else beats, and in words where a model is worth its cost."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np


def pareto_front(cost: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Indices of what is not dominated, from the cheapest on; entries with a NaN are on no front.

    One dominates another if neither its cost nor its error is larger, and one of them is smaller. cost, error: (n,).
    """
    cost, error = np.asarray(cost, float), np.asarray(error, float)
    known = np.flatnonzero(np.isfinite(cost) & np.isfinite(error))
    front = []
    for index in known:
        no_worse = (cost[known] <= cost[index]) & (error[known] <= error[index])
        better = (cost[known] < cost[index]) | (error[known] < error[index])
        if not np.any(no_worse & better):
            front.append(index)
    return np.array(sorted(front, key=lambda index: (cost[index], error[index])), dtype=int)


def verdict(model: Mapping[str, Any], others: Sequence[Mapping[str, Any]], cost: str,
            measures: Mapping[str, str]) -> list[str]:
    """Two sentences: in which measures a method is worth its cost beside others, and in which it is not.

    It is worth it where no other one that costs no more is as accurate. Rows hold `label`, `cost` and the measures by
    key, None where there is no number, and may hold their standard deviations over realisations as `KEY_spread`: what
    differs by less than the larger of two is as accurate. `measures` gives their names in words. A row without a
    number counts as beaten.
    """
    if not others:
        return ["No other method was run."]
    worth, not_worth = [], []
    for key, words in measures.items():
        if None in (model[key], model[cost]):
            not_worth.append(f"{words} (no number)")
            continue
        known = [row for row in others if None not in (row[key], row[cost])]
        rivals = [row for row in known if row[cost] <= model[cost] and not _worse(row, model, key)]
        beaten = sum(row not in known or _worse(row, model, key) for row in others)
        score = f"{words} ({model[key]:.3g}, {beaten} of {len(others)} others beaten; "
        if rivals:
            named = ", ".join(_compared(row, model, key, cost) for row in rivals)
            not_worth.append(f"{score}as accurate and no slower: {named})")
        elif known:
            best = min(known, key=lambda row: row[key])
            worth.append(f"{score}the best of them: {_compared(best, model, key, cost)})")
        else:
            worth.append(f"{score}none of them has a number)")
    name = model["label"]
    return [f"{name} is worth its cost in {', '.join(worth)}: nothing that is as fast is as accurate." if worth else
            f"{name} is worth its cost in no measure.",
            f"It is not in {', '.join(not_worth)}." if not_worth else
            "There is no measure in which another method is as accurate and no slower."]


def cheapest_grid(model: Mapping[str, Any], grids: Sequence[Mapping[str, Any]], cost: str,
                  times: Mapping[str, str]) -> str:
    """A sentence: the grid of least cost that keeps the velocity error at or below the model's at some times, by key in
    `times` with words for each, or that none does. Of several realisations it is of means. "" where the model has not
    all numbers."""
    def errors(row: Mapping[str, Any]) -> str:
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


def _worse(row: Mapping[str, Any], model: Mapping[str, Any], key: str) -> bool:
    """Whether the error of a row is larger, by more than either's spread."""
    spread = max(one.get(f"{key}_spread") or 0.0 for one in (row, model))
    return row[key] > model[key] + spread


def _compared(row: Mapping[str, Any], model: Mapping[str, Any], key: str, cost: str) -> str:
    return f"{row['label']}, {row[key]:.3g} in {row[cost] / model[cost]:.2g} of its time"
