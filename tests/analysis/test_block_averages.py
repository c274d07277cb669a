"""Errors of means over blocks against those that repeated runs have."""

import numpy as np
import pytest

from eddies.analysis.block_averages import Blocks


def noise_with_memory(runs, samples, memory, seed=3):
    """Runs of a signal of variance one that forgets in `memory` samples (an autoregressive process)."""
    random, decay = np.random.default_rng(seed), np.exp(-1 / memory)
    signal = np.empty((runs, samples))
    signal[:, 0] = random.normal(size=runs)
    for sample in range(1, samples):
        signal[:, sample] = decay * signal[:, sample - 1] + np.sqrt(1 - decay**2) * random.normal(size=runs)
    return signal


def test_the_error_is_the_scatter_of_the_means_of_many_runs():
    """Sixteen blocks of five correlation times each. That of single samples would be a fifth of the true error."""
    runs = noise_with_memory(300, 1600, memory=20)
    blocks = Blocks.of(np.arange(1600.0), 100)
    assert len(blocks.members) == 15  # of a span of 1599
    found = [blocks.mean(run) for run in runs]
    scatter = np.std([estimate.value for estimate in found])
    # Neighbouring blocks still share a little, a fifth of a memory each way: the error is low by a tenth at most.
    assert np.sqrt(np.mean([estimate.error**2 for estimate in found])) == pytest.approx(scatter, rel=0.15)


def test_the_error_of_a_trend_is_the_scatter_of_slopes():
    times = np.arange(1600.0)
    blocks = Blocks.of(times, 100)
    found = [blocks.trend(run + 0.002 * times) for run in noise_with_memory(300, 1600, memory=20)]
    slopes = [estimate.value for estimate in found]
    scatter = np.std(slopes)
    assert np.mean(slopes) == pytest.approx(0.002, abs=3 * scatter / np.sqrt(300))
    assert np.sqrt(np.mean([estimate.error**2 for estimate in found])) == pytest.approx(scatter, rel=0.15)


def test_blocks_are_equal_and_none_is_shorter_than_asked_for():
    times = 0.1 * np.arange(25)  # a span of 2.4
    blocks = Blocks.of(times, 1.0)
    assert [len(rows) for rows in blocks.members] == [12, 13]
    assert np.array_equal(np.concatenate(blocks.members), np.arange(25))
    assert len(Blocks.of(times[:20], 1.0).members) == 1 and len(Blocks.of(times[:1], 1.0).members) == 1


def test_a_function_of_the_mean_has_the_error_of_that_mean():
    """The logarithm of a mean near 100 varies as the mean does, over 100."""
    samples = 100 + noise_with_memory(1, 1600, memory=20)[0]
    blocks = Blocks.of(np.arange(1600.0), 100)
    plain, logarithm = blocks.mean(samples), blocks.of_mean(samples, np.log)
    assert logarithm.error == pytest.approx(plain.error / plain.value, rel=0.01)
    assert logarithm.value == pytest.approx(np.log(plain.value))


def test_without_two_blocks_there_is_no_error():
    blocks = Blocks.of(np.linspace(0, 1.9, 20), 1.0)
    mean, slope = blocks.mean(np.arange(20.0)), blocks.trend(np.arange(20.0))
    assert mean.value == 9.5 and mean.known_error is None
    assert slope.value == pytest.approx(10) and slope.known_error is None
    assert np.isnan(Blocks.of(np.zeros(1), 1.0).trend(np.ones(1)).value)
