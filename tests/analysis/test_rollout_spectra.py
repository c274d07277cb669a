"""Spectra of a rollout are compared at the times, and as far, as they are known."""

import numpy as np
import pytest

from eddies.analysis.rollout_spectra import RolloutSpectra

SHELLS = np.arange(6)


def table(times, size, factor=1.0, name="energy"):
    """Spectra 2^-k at a time t, times e^t and a factor."""
    return {"time": np.asarray(times), "wavenumber": np.arange(size),
            name: factor * np.exp(np.asarray(times))[:, None] * 0.5 ** np.arange(size)}


def test_all_are_those_of_the_moment_nearest_to_a_time():
    """The model has frames beyond the truth, and the flow has been followed before the start."""
    flow = table([0.0, 0.5, 1.0, 1.5, 2.0], 9, name="filtered")
    run = RolloutSpectra(table([0.0, 0.5, 1.0, 1.5], 6, 1.2), table([0.0, 0.5, 1.0], 6, 0.9), flow, start_time=1.0)
    assert run.times().tolist() == [0, 0.5, 1.0] and run.times(0.9).tolist() == [0, 0.5]
    at = run.at(1.4)
    assert at.time == 1.0 and at.wavenumber.tolist() == SHELLS.tolist()
    assert at.truth == pytest.approx(0.9 * np.e * 0.5**SHELLS) and at.model == pytest.approx(1.2 * np.e * 0.5**SHELLS)
    assert at.filtered == pytest.approx(np.e**2 * 0.5**SHELLS)
    assert at.error("truth", 4.0) == pytest.approx(1 - np.log(0.9))
    assert at.bands("model", 4.0) == pytest.approx(dict.fromkeys(("1-2", "3-4"), 1.2 / np.e))


def test_no_shell_counts_that_one_of_them_has_not():
    flow = table([0.0], 5, name="filtered")
    at = RolloutSpectra(table([0.0], 6), table([0.0], 6), flow, 0.0).at(0.0)
    assert list(at.bands("model", 20.0)) == ["1-2", "3-4"] and at.error("model", 20.0) == 0
    assert RolloutSpectra(table([0.0], 6), table([0.0], 6), None, 0.0).at(0.0).filtered is None
