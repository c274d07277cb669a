"""What a rollout should keep: its momentum, its mean density, and how evenly its particles lie."""

import numpy as np

from eddies.analysis.disorder import count_variance
from eddies.analysis.rollout import Rollout


def momentum_drift(start: np.ndarray, end: np.ndarray) -> float:
    """|sum v(end) - sum v(start)| / (N u') of velocities (N, 3), u' the rms of a component at the start about its mean.

    Tracers of a flow that keeps its momentum have one of the order of N^(-1/2): they are a sample of it.
    """
    start, end = (velocity.astype(float) for velocity in (start, end))
    return float(np.linalg.norm(end.mean(0) - start.mean(0)) / np.std(start - start.mean(0)))


def mean_drift(start: np.ndarray, end: np.ndarray) -> float:
    """(<rho(end)> - <rho(start)>) / <rho(start)> of densities (N,): below zero where it is lost."""
    before = np.mean(start, dtype=float)
    return float((np.mean(end, dtype=float) - before) / before)


def drifts(run: Rollout) -> dict[str, dict[str, float]]:
    """Drifts of "model" and "truth" by name, from the first to the last common time.

    `momentum_drift` and, of a model that integrates a density, `density_drift`; `count_variance` is the variance of
    particle counts at the last time over that of random points.
    """
    last = len(run.common.times) - 1
    columns = {"momentum_drift": ("velocity", momentum_drift)}
    if run.attributes.get("integrates_density", False):
        columns["density_drift"] = ("density", mean_drift)
    found = {}
    for name, (column, drift) in columns.items():
        start, end = run.pair(0, column), run.pair(last, column)
        found[name] = {of: drift(getattr(start, of), getattr(end, of)) for of in ("model", "truth")}
    position = run.pair(last, "position")
    return found | {"count_variance": {of: count_variance(getattr(position, of), run.length)
                                       for of in ("model", "truth")}}
