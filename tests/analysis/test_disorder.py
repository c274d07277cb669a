"""Order and conservation of particles: random points, lattices, clusters, and known drifts."""

import numpy as np
import pytest

from eddies.analysis import disorder
from eddies.analysis.disorder import (
    count_variance, distance_probabilities, mean_drift, mean_spacing, momentum_drift, nearest_distances,
    random_distance_density,
)
from eddies.analysis.lagrangian import minimum_image
from eddies.analysis.pdfs import bin_centres

LENGTH = 2 * np.pi


def random_points(total, seed=3):
    return np.random.default_rng(seed).uniform(0, LENGTH, (total, 3))


def by_comparing_all(position):
    apart = np.linalg.norm(minimum_image(position[:, None] - position[None], LENGTH), axis=-1)
    np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1)


@pytest.mark.parametrize("position", [
    random_points(1), random_points(5), random_points(700),
    np.concatenate([0.05 * random_points(500), [[3, 3, 3], [3, 3, 5.5]]]),  # a cluster, and two far from all
    np.repeat(random_points(60), 2, axis=0),
    random_points(400) * [1, 1, 0],
], ids=["one", "few", "many", "cluster", "coincident", "sheet"])
def test_nearest_distances(position):
    assert nearest_distances(position, LENGTH) == pytest.approx(by_comparing_all(position), abs=1e-14)
    assert nearest_distances(position + LENGTH, LENGTH) == pytest.approx(by_comparing_all(position), abs=1e-14)


def test_at_most_so_many_particles_and_pairs_are_sampled(monkeypatch):
    monkeypatch.setattr(disorder, "SAMPLED", 100)
    position = random_points(300)
    found = nearest_distances(position, LENGTH)
    assert found[[0, -1]] == pytest.approx(by_comparing_all(position)[[0, -1]]) and found.size == 100
    monkeypatch.setattr(disorder, "PAIRS", 6000)
    assert nearest_distances(np.full((300, 3), 1.0), LENGTH).tolist() == [0.0] * 20


def test_random_points_have_the_distribution_of_hertz():
    """A bin of 10,000 points holds a share p within three times sqrt(2 p / 10,000), as neighbours are mutual."""
    edges = disorder.DISTANCE_EDGES
    shares = distance_probabilities(random_points(10_000), LENGTH)
    exact = -np.diff(np.exp(-4 / 3 * np.pi * edges**3))
    assert np.all(np.abs(shares - exact) < 3 * np.sqrt(2 * exact / 10_000) + 3e-4)
    assert random_distance_density(bin_centres(edges)) * np.diff(edges) == pytest.approx(exact, abs=2e-3)


def test_counts_of_lattices_random_points_and_clusters():
    lattice = np.stack(np.meshgrid(*[(np.arange(8) + 0.5) * LENGTH / 8] * 3), axis=-1).reshape(-1, 3)
    assert nearest_distances(lattice, LENGTH) == pytest.approx(mean_spacing(512, LENGTH))
    assert count_variance(lattice, LENGTH) == 0
    # Over 10 samples of 1000 cells each the mean is 1 within 3 sqrt(2 / 10,000).
    assert np.mean([count_variance(random_points(8000, seed), LENGTH) for seed in range(10)]) == pytest.approx(
        1, abs=0.042)
    # Each point doubled: twice the variance at the same mean.
    assert count_variance(np.repeat(random_points(4000), 2, axis=0), LENGTH) == pytest.approx(2, rel=0.2)
    assert np.isnan(count_variance(random_points(20), LENGTH))


def test_momentum_drift_is_in_units_of_the_fluctuation():
    """u'^2 = (1 + 4 + 4)/3 without the mean wind. 5000 velocities give u' to 1 %."""
    velocity = np.random.default_rng(6).normal(size=(5000, 3)) * [1.0, 2.0, 2.0] + [10.0, 0.0, 0.0]
    assert momentum_drift(velocity, velocity + [0.3, 0.0, 0.4]) == pytest.approx(0.5 / 3**0.5, rel=0.01)
    opposite = velocity + np.repeat([[1.0], [-1.0]], 2500, axis=0)
    assert momentum_drift(velocity, opposite) == pytest.approx(0, abs=1e-14)


@pytest.mark.parametrize("dtype, rounding", [(np.float64, 1e-14), (np.float32, 1e-7)])
def test_single_precision_hides_no_drift(dtype, rounding):
    start = (1 + 0.01 * np.random.default_rng(6).normal(size=5000)).astype(dtype)
    lost = (start - dtype(1e-4) * start).astype(dtype)
    assert mean_drift(start, lost) == pytest.approx(-1e-4, abs=rounding)
    assert mean_drift(start, start[::-1]) == pytest.approx(0, abs=1e-15)
