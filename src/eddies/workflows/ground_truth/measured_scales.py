"""Reference scales as they are measured on the particles of a ground truth."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_sum

MEAN_DENSITY = 1.0
# What changes along a trajectory, and the name of its rate of change.
RATES = {"velocity": "acceleration", "density": "density_rate"}
MEANS = {"velocity": 0.0, "density": MEAN_DENSITY}

Columns = Mapping[str, np.ndarray]


def measured_scales(comm: Comm, at: Columns, before: Columns, after: Columns, interval: float) -> dict[str, float]:
    """Root mean squares over all particles, of one component where there are three; collective.

    velocity_rms and acceleration_rms, and with a density density_rms (of its fluctuation) and density_rate_rms: values
    of the frame `at`, rates from the difference of two frames that are `interval` apart. Frames are this rank's rows of
    `velocity` (n, 3) and, or not, `density` (n,), the same particles in all of them.
    """
    scales = {}
    for name, rate in RATES.items():
        if name in at:
            scales[f"{name}_rms"] = _rms(comm, at[name] - MEANS[name])
            scales[f"{rate}_rms"] = _rms(comm, (after[name] - before[name]) / interval)
    return scales


def _rms(comm: Comm, values: np.ndarray) -> float:
    square, count = global_sum(comm, np.array([np.sum(values**2), values.size]))
    return float(np.sqrt(square / count))
