import numpy as np
import pytest

from eddies.analysis.errors import fluctuations, normalized_l2, rms_log_ratio, velocity_error


def test_normalized_l2():
    truth = np.random.default_rng(1).normal(size=(50, 3))
    assert normalized_l2(np.zeros_like(truth), truth) == 1
    assert normalized_l2(1.25 * truth, truth) == pytest.approx(0.25)
    with pytest.raises(ValueError, match="shape"):
        normalized_l2(np.ones(3), np.ones(4))
    assert np.isnan(normalized_l2(np.ones(3), np.zeros(3)))


@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_a_velocity_error_is_relative_to_the_fluctuation(kind):
    """The same in a frame that moves a hundred times as fast as the fluctuation; undefined for a uniform flow."""
    random = np.random.default_rng(2)
    truth, error = random.normal(size=(200, 3)), 0.1 * random.normal(size=(200, 3))
    expected = np.linalg.norm(error) / np.linalg.norm(truth - truth.mean(axis=0))
    for wind in (0.0, 100.0):
        found = velocity_error((truth + error + wind).astype(kind), (truth + wind).astype(kind))
        assert found == pytest.approx(expected, rel=1e4 * np.finfo(kind).eps)  # a hundred times that of the error
    uniform = np.tile(np.array([0.1, 0.7, -0.3], kind), (200, 1))
    assert np.isnan(velocity_error(uniform + kind(0.1), uniform)) and not fluctuations(uniform).any()


def test_rms_log_ratio_counts_a_factor_alike_both_ways():
    truth = np.array([1e-9, 1.0, 40.0])
    assert rms_log_ratio(truth * np.exp([0.3, -0.3, 0.3]), truth) == pytest.approx(0.3)
    assert rms_log_ratio(truth * [0, 1, 1], truth) == np.inf
    assert np.isnan(rms_log_ratio(np.empty(0), np.empty(0)))
