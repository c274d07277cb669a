import numpy as np
import pytest

from eddies.analysis.errors import normalized_l2, rms_log_ratio


def test_normalized_l2():
    truth = np.random.default_rng(1).normal(size=(50, 3))
    assert normalized_l2(np.zeros_like(truth), truth) == 1
    assert normalized_l2(1.25 * truth, truth) == pytest.approx(0.25)
    with pytest.raises(ValueError, match="shape"):
        normalized_l2(np.ones(3), np.ones(4))
    with pytest.raises(ValueError, match="zero"):
        normalized_l2(np.ones(3), np.zeros(3))


def test_rms_log_ratio_counts_a_factor_alike_both_ways():
    truth = np.array([1e-9, 1.0, 40.0])
    assert rms_log_ratio(truth * np.exp([0.3, -0.3, 0.3]), truth) == pytest.approx(0.3)
    assert rms_log_ratio(truth * [0, 1, 1], truth) == np.inf
    assert np.isnan(rms_log_ratio(np.empty(0), np.empty(0)))
