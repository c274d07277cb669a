import numpy as np
import pytest

from eddies.analysis.errors import (
    band_ratios, fluctuations, normalized_l2, rms_log_ratio, spectrum_error, velocity_error,
)


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


def test_a_factor_in_every_shell_is_an_error_of_its_logarithm():
    reference = np.array([9.0, 3.0, 0.4, 1e-3, 1e-5, 1e-8])
    for factor in (0.2, -0.2):
        assert spectrum_error(reference * np.exp(factor), reference, 4.7) == pytest.approx(0.2)
    # One of the shells 1 to 3 is wrong by a factor e^3.
    energy = reference * [5, 1, 1, np.exp(3), 0, 7]
    assert spectrum_error(energy, reference, 3.9) == pytest.approx(3 / np.sqrt(3))
    assert spectrum_error(energy, reference, 0.5) == 0 and spectrum_error(energy, reference, 4) == np.inf


def test_bands_double_and_the_last_ends_at_the_largest_wavenumber():
    reference = 1 / np.arange(1, 40.0) ** 2
    energy = reference * np.where(np.arange(39) < 9, 1.0, 2.0)
    found = band_ratios(energy, reference, 20.3)
    assert list(found) == ["1-2", "3-4", "5-8", "9-16", "17-20"]
    assert list(found.values()) == pytest.approx([1, 1, 1, 2, 2])
    assert list(band_ratios(energy, reference, 5.0)) == ["1-2", "3-4", "5"]
    assert list(band_ratios(energy, reference, 0.7)) == ["1"]
