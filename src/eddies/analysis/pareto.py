"""Error against cost: the Pareto front, and sentences that say where a model is worth its cost."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

# A method has the keys `label`, COST, and one for each error. An unknown cost or error is None. The key KEY_spread, if
# present, holds the standard deviation of the error KEY over realisations.
Method = Mapping[str, Any]
COST = "wall_seconds"


def pareto_front(cost: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Return the indices of the points that no other point dominates, in order of cost.

    `cost` and `error` are (n,). Points with NaN are left out. A point dominates another if neither its cost nor its
    error is larger and one of them is smaller.
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


def verdict(model: Method, others: Sequence[Method], measures: Mapping[str, str]) -> list[str]:
    """Return two texts: the measures in which the model is worth its cost, and its rivals in the other measures.

    The model is worth its cost in a measure if it has no rival. A rival is another method that costs no more and is at
    least as accurate. Errors count as equal if they differ by at most the larger of their spreads over realisations.
    A method that lacks the cost or the error is no rival. For each measure with rivals, the second text names the
    cheapest rival and the number of further ones. It also names the measures for which the model has no number. Without
    other methods, there is one text that says so. `measures` maps keys of errors to their names in words.
    """
    if not others:
        return ["No other method was run."]
    name, worth, beaten, unknown = model["label"], [], [], []
    for key, words in measures.items():
        short = words.partition(" (")[0]
        if None in (model[key], model[COST]):
            unknown.append(short)
            continue
        rivals = sorted((row for row in others if None not in (row[key], row[COST])
                         and row[COST] <= model[COST] and not _worse(row, model, key)), key=lambda row: row[COST])
        if rivals:
            beaten.append(f"{short}: {rivals[0]['label']}" + (f" and {len(rivals) - 1} more" if rivals[1:] else ""))
        else:
            worth.append(short)
    found = [f"Methods that are as accurate as {name} and cost no more (only the cheapest is named): "
             f"{'; '.join(beaten)}."] if beaten else []
    found += [f"{name} has no number for {'; '.join(unknown)}."] if unknown else []
    return [f"{name} is {'' if worth else 'not '}worth its cost in {'; '.join(worth) or 'any measure'}.",
            " ".join(found) or "In every measure all other methods are slower or less accurate."]


def cheapest_grid(model: Method, grids: Sequence[Method], times: Mapping[str, str]) -> str:
    """Return a sentence that names the cheapest grid whose velocity error is at most the model's at all `times`.

    `times` maps keys of errors to the times in words. Errors are compared without their spreads over realisations. The
    sentence is empty without `times`, or if the model's cost or one of its errors is None.
    """
    if not times or None in [model[key] for key in (COST, *times)]:
        return ""
    limit = f"has at most the velocity error of {model['label']} after {' and '.join(times.values())}"
    kept = [row for row in grids if None not in [row[key] for key in (COST, *times)]
            and all(row[key] <= model[key] for key in times)]
    if not kept:
        return f"No grid {limit}."
    best = min(kept, key=lambda row: row[COST])
    return f"The cheapest grid that {limit} is {best['label']}; it costs {best[COST] / model[COST]:.2g} times as much."


def _worse(row: Method, model: Method, key: str) -> bool:
    """Return whether the error `key` of the method `row` exceeds the model's error by more than the larger spread.

    The spread of an error is its standard deviation over realisations, or 0 if this is unknown.
    """
    spread = max(one.get(f"{key}_spread") or 0.0 for one in (row, model))
    return row[key] > model[key] + spread
