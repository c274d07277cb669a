import numpy as np
import pytest

from eddies.analysis.pdfs import (
    bin_edges, bin_probabilities, gaussian, kl_divergence, pdf, sampling_divergence, standardized,
)


def test_a_gaussian_sample_follows_the_normal_density():
    values, edges = np.random.default_rng(3).normal(2.0, 3.0, size=(200_000, 2)), bin_edges(4, 40)
    centres = (edges[1:] + edges[:-1]) / 2
    assert np.allclose(pdf(standardized(values), edges)[1:-1], gaussian(centres)[1:-1], atol=4e-3)
    assert standardized(np.array([1.0, 3.0]), np.array([0.0, 4.0])) == pytest.approx([-0.5, 0.5])


def test_a_boost_changes_nothing():
    """Each component has its own mean."""
    values, boost = np.random.default_rng(4).normal(size=(1000, 3)), np.array([5.0, 0.0, -1.0])
    assert np.allclose(standardized(values + boost), standardized(values), atol=1e-13)  # round-off of sums of 5000


def test_outliers_keep_their_mass():
    values, edges = np.array([-50.0, -0.5, 0.5, 0.6, 70.0]), bin_edges(1, 4)
    assert np.sum(pdf(values, edges) * np.diff(edges)) == pytest.approx(1)
    assert bin_probabilities(values, edges) == pytest.approx([0.2, 0.2, 0, 0.6])


def test_divergence_of_two_gaussians():
    """D(N(0,1) | N(m,s)) = ln s + (1 + m^2) / (2 s^2) - 1/2."""
    edges = bin_edges(6, 200)
    centres, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    mean, deviation = 0.3, 1.2
    truth = gaussian(centres) * width
    prediction = gaussian((centres - mean) / deviation) / deviation * width
    exact = np.log(deviation) + (1 + mean**2) / (2 * deviation**2) - 0.5
    assert kl_divergence(truth, prediction) == pytest.approx(exact, rel=3e-3)
    assert kl_divergence(truth, truth) == 0


def test_divergence_is_forward_and_finite():
    truth, prediction = np.array([0.5, 0.5, 0.0]), np.array([1.0, 0.0, 0.0])
    missed, invented = kl_divergence(truth, prediction), kl_divergence(prediction, truth)
    assert np.isfinite(missed) and missed > 5 * invented > 0
    with pytest.raises(ValueError, match="bins"):
        kl_divergence(truth, truth[:2])


def test_divergence_of_samples_of_one_distribution():
    """The mean of chi-square: (K - 1) / n for K bins of n uniform values; the mean of 30 draws is good to 6 %."""
    draws = np.random.default_rng(7).uniform(size=(30, 5000))
    found = [sampling_divergence(5000, lambda rows: bin_probabilities(values[rows], np.linspace(0, 1, 21)))
             for values in draws]
    assert np.mean(found) == pytest.approx(19 / 5000, rel=0.2)


def test_unusable_samples_are_refused():
    for values, match in ((np.array([1.0, np.nan]), "finite"), (np.array([]), "at least one")):
        with pytest.raises(ValueError, match=match):
            pdf(values, bin_edges(1, 4))
    with pytest.raises(ValueError, match="constant"):
        standardized(np.ones(4))
