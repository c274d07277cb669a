import numpy as np
import pytest

from eddies.analysis.errors import normalized_l2


def test_zero_prediction_scores_one():
    truth = np.random.default_rng(1).normal(size=(50, 3))
    assert normalized_l2(np.zeros_like(truth), truth) == 1
    assert normalized_l2(truth, truth) == 0
    assert normalized_l2(1.25 * truth, truth) == pytest.approx(0.25)


def test_unlike_shapes_and_zero_truth_are_refused():
    with pytest.raises(ValueError, match="shape"):
        normalized_l2(np.ones(3), np.ones(4))
    with pytest.raises(ValueError, match="zero"):
        normalized_l2(np.ones(3), np.zeros(3))
