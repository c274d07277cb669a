"""Standard errors of block averages against the scatter of repeated runs."""

import numpy as np
import pytest

from eddies.analysis.block_averages import Blocks

TIMES = np.arange(1600.0)


def noise_with_memory(runs, memory=20):
    """Runs of 1600 samples of an autoregressive process with variance one and a correlation time of `memory`."""
    random, decay = np.random.default_rng(3), np.exp(-1 / memory)
    signal = np.empty((runs, 1600))
    signal[:, 0] = random.normal(size=runs)
    for sample in range(1, 1600):
        signal[:, sample] = decay * signal[:, sample - 1] + np.sqrt(1 - decay**2) * random.normal(size=runs)
    return signal


@pytest.mark.parametrize("name, slope", [("mean", 0.0), ("trend", 0.002)])
def test_the_error_is_the_scatter_of_many_runs(name, slope):
    """Blocks of five correlation times. Neighbouring blocks share a little, so that the error is low by up to 10 %."""
    blocks = Blocks.of(TIMES, 100)
    assert len(blocks.members) == 15  # of a span of 1599
    found = [getattr(blocks, name)(run + slope * TIMES) for run in noise_with_memory(300)]
    scatter = np.std([estimate.value for estimate in found])
    assert np.mean([estimate.value for estimate in found]) == pytest.approx(slope, abs=3 * scatter / np.sqrt(300))
    assert np.sqrt(np.mean([estimate.error**2 for estimate in found])) == pytest.approx(scatter, rel=0.15)


def test_the_logarithm_of_a_mean_near_100_has_a_hundredth_of_its_error():
    samples, blocks = 100 + noise_with_memory(1)[0], Blocks.of(TIMES, 100)
    plain, logarithm = blocks.mean(samples), blocks.of_mean(samples, np.log)
    assert logarithm.error == pytest.approx(plain.error / plain.value, rel=0.01)
    assert logarithm.value == pytest.approx(np.log(plain.value))


def test_blocks_are_equal_and_at_least_as_long_as_given():
    times = 0.1 * np.arange(25)  # a span of 2.4
    blocks = Blocks.of(times, 1.0)
    assert [len(rows) for rows in blocks.members] == [12, 13]
    assert np.array_equal(np.concatenate(blocks.members), np.arange(25))
    assert len(Blocks.of(times[:20], 1.0).members) == 1 and len(Blocks.of(times[:1], 1.0).members) == 1


def test_one_block_has_no_error():
    blocks = Blocks.of(np.linspace(0, 1.9, 20), 1.0)
    mean, slope = blocks.mean(np.arange(20.0)), blocks.trend(np.arange(20.0))
    assert mean.value == 9.5 and np.isnan(mean.error)
    assert slope.value == pytest.approx(10) and np.isnan(slope.error)
    assert np.isnan(Blocks.of(np.zeros(1), 1.0).trend(np.ones(1)).value)
