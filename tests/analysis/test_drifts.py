"""Momentum and mean density that a rollout loses, against losses that are put in."""

import numpy as np
import pytest

from eddies.analysis.drifts import mean_drift, momentum_drift

RNG = np.random.default_rng(6)
VELOCITY = RNG.normal(size=(5000, 3)) * [1.0, 2.0, 2.0] + [10.0, 0.0, 0.0]


def test_a_wind_is_told_in_the_rms_of_a_component_about_the_mean():
    """u'^2 = (1 + 4 + 4)/3; a wind of its own at the start is no part of it. What is random in 5000 velocities changes
    u' by less than 1 %."""
    assert momentum_drift(VELOCITY, VELOCITY + [0.3, 0.0, 0.4]) == pytest.approx(0.5 / 3**0.5, rel=0.01)


def test_changes_that_cancel_are_no_drift():
    opposite = VELOCITY + np.repeat([[1.0], [-1.0]], 2500, axis=0)
    assert momentum_drift(VELOCITY, opposite) == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize("dtype, rounding", [(np.float64, 1e-14), (np.float32, 1e-7)])
def test_single_precision_hides_no_drift(dtype, rounding):
    """As rollouts are stored: sums are taken in double precision."""
    start = (1 + 0.01 * RNG.normal(size=5000)).astype(dtype)
    lost = (start - dtype(1e-4) * start).astype(dtype)
    assert mean_drift(start, lost) == pytest.approx(-1e-4, abs=rounding)
    assert mean_drift(start, start[::-1]) == pytest.approx(0, abs=1e-15)
