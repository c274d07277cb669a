import numpy as np
import pytest

from eddies.analysis.pdfs import (
    bin_edges, bin_probabilities, gaussian, joint_probabilities, kl_divergence, pdf, sampling_divergence, standardized,
)


def test_gaussian_sample_follows_the_normal_density():
    values = np.random.default_rng(3).normal(2.0, 3.0, size=400_000)
    edges = bin_edges(4, 40)
    centres = (edges[1:] + edges[:-1]) / 2
    assert np.allclose(pdf(standardized(values), edges)[1:-1], gaussian(centres)[1:-1], atol=4e-3)


def test_outliers_keep_their_mass():
    values = np.array([-50.0, -0.5, 0.5, 0.6, 70.0])
    edges = bin_edges(1, 4)
    density = pdf(values, edges)
    assert np.sum(density * np.diff(edges)) == pytest.approx(1)
    assert bin_probabilities(values, edges) == pytest.approx([0.2, 0.2, 0, 0.6])


def test_shape_of_the_array_does_not_matter():
    values = np.random.default_rng(4).normal(size=(30, 8, 3))
    edges = bin_edges(3, 20)
    assert np.array_equal(pdf(values, edges), pdf(values.ravel(), edges))
    assert np.array_equal(pdf(values, edges), pdf(values.reshape(3, 240), edges))


def test_joint_probabilities_have_the_marginals():
    rng = np.random.default_rng(5)
    first, second = rng.normal(size=1000), 2 * rng.normal(size=1000)
    edges = bin_edges(1.5, 10), bin_edges(3, 12)
    joint = joint_probabilities(first, second, *edges)
    assert joint.sum() == pytest.approx(1)
    assert np.allclose(joint.sum(axis=1), bin_probabilities(first, edges[0]))
    assert np.allclose(joint.sum(axis=0), bin_probabilities(second, edges[1]))


def test_divergence_of_two_gaussians():
    """D(N(0,1) | N(m,s)) = ln s + (1 + m^2) / (2 s^2) - 1/2."""
    edges = bin_edges(9, 400)
    centres, width = (edges[1:] + edges[:-1]) / 2, edges[1] - edges[0]
    mean, deviation = 0.3, 1.2
    truth = gaussian(centres) * width
    prediction = gaussian((centres - mean) / deviation) / deviation * width
    exact = np.log(deviation) + (1 + mean**2) / (2 * deviation**2) - 0.5
    assert kl_divergence(truth, prediction, floor=1e-12) == pytest.approx(exact, rel=1e-4)
    assert kl_divergence(truth, truth) == 0


def test_divergence_is_forward_and_finite():
    truth, prediction = np.array([0.5, 0.5, 0.0]), np.array([1.0, 0.0, 0.0])
    missed, invented = kl_divergence(truth, prediction), kl_divergence(prediction, truth)
    assert np.isfinite(missed) and missed > 5 * invented > 0


def test_divergence_of_samples_of_one_distribution():
    """It is (K - 1) / n for K bins and n independent values in each: the mean of chi-square, in the mean of 30 draws
    good to 6 %."""
    draws = np.random.default_rng(7).uniform(size=(30, 5000))
    found = [sampling_divergence(5000, lambda rows: bin_probabilities(values[rows], np.linspace(0, 1, 21)))
             for values in draws]
    assert np.mean(found) == pytest.approx(19 / 5000, rel=0.2)


def test_the_floor_of_a_joint_pdf_is_what_two_samples_have():
    """Of normal pairs in 20 x 20 bins, most of them empty, as of Q and R: there one over n does not hold for each bin,
    but nearly so for their sum. Means over 30 draws, good to 3 %."""
    random, edges = np.random.default_rng(7), np.linspace(-4, 4, 21)

    def probabilities(values):
        return joint_probabilities(*values.T, edges, edges)

    samples = random.normal(size=(30, 2, 20000, 2))
    true = np.mean([kl_divergence(probabilities(one), probabilities(other)) for one, other in samples])
    found = np.mean([sampling_divergence(20000, lambda rows: probabilities(one[rows])) for one, _ in samples])
    assert found == pytest.approx(true, rel=0.1)


def test_unusable_samples_are_refused():
    with pytest.raises(ValueError, match="finite"):
        pdf(np.array([1.0, np.nan]), bin_edges(1, 4))
    with pytest.raises(ValueError, match="at least one"):
        pdf(np.array([]), bin_edges(1, 4))
    with pytest.raises(ValueError, match="constant"):
        standardized(np.ones(4))


def test_standardised_by_a_reference():
    values, reference = np.array([1.0, 3.0]), np.array([0.0, 4.0])
    assert standardized(values, reference) == pytest.approx([-0.5, 0.5])
