import numpy as np
import pytest

from eddies.analysis import disorder
from eddies.analysis.disorder import (
    count_variance, distance_probabilities, mean_spacing, nearest_distances, random_distance_density,
)
from eddies.analysis.lagrangian import minimum_image

LENGTH = 2 * np.pi


def random_points(total, seed=3):
    return np.random.default_rng(seed).uniform(0, LENGTH, (total, 3))


def lattice(side):
    return np.stack(np.meshgrid(*[(np.arange(side) + 0.5) * LENGTH / side] * 3), axis=-1).reshape(-1, 3)


def by_comparing_all(position):
    apart = np.linalg.norm(minimum_image(position[:, None] - position[None], LENGTH), axis=-1)
    np.fill_diagonal(apart, np.inf)
    return apart.min(axis=1)


@pytest.mark.parametrize("position", [
    random_points(5), random_points(80), random_points(700),
    np.concatenate([0.05 * random_points(500), [[3, 3, 3], [3, 3, 5.5]]]),  # a clump, and two far from all
    np.repeat(random_points(60), 2, axis=0),
    random_points(400) * [1, 1, 0],
], ids=["five", "few", "many", "clump", "coincident", "sheet"])
def test_nearest_distances_are_those_found_by_comparing_all(position):
    assert nearest_distances(position, LENGTH) == pytest.approx(by_comparing_all(position), abs=1e-14)
    assert nearest_distances(position + LENGTH, LENGTH) == pytest.approx(by_comparing_all(position), abs=1e-14)


def test_many_pairs_are_taken_in_blocks(monkeypatch):
    position = random_points(300)
    monkeypatch.setattr(disorder, "PAIRS_TOGETHER", 7)
    assert nearest_distances(position, LENGTH) == pytest.approx(by_comparing_all(position))
    monkeypatch.setattr(disorder, "SAMPLED", 100)
    found = nearest_distances(position, LENGTH)
    assert found[[0, -1]] == pytest.approx(by_comparing_all(position)[[0, -1]]) and found.size == 100


def test_one_particle_has_no_neighbour():
    assert nearest_distances(random_points(1), LENGTH) == np.inf


def test_random_points_have_the_exact_distribution():
    """A bin of 10,000 points holds a share p within three times sqrt(p / 10,000), neighbours being mutual."""
    edges = disorder.DISTANCE_EDGES
    shares = distance_probabilities(random_points(10_000), LENGTH)
    exact = -np.diff(np.exp(-4 / 3 * np.pi * edges**3))
    assert np.all(np.abs(shares - exact) < 3 * np.sqrt(2 * exact / 10_000) + 3e-4)
    fine = np.linspace(0, 1.5, 3001)
    middle = (fine[1:] + fine[:-1]) / 2
    assert np.sum(random_distance_density(middle)) * (fine[1] - fine[0]) == pytest.approx(1, abs=1e-5)


def test_a_lattice_has_its_spacing():
    position = lattice(8)
    assert nearest_distances(position, LENGTH) == pytest.approx(mean_spacing(512, LENGTH))
    assert count_variance(position, LENGTH) == 0


def test_counts_of_random_points_vary_as_they_should():
    """Over 10 samples of 1000 cells each the mean is 1 within 3 sqrt(2 / 10,000)."""
    found = [count_variance(random_points(8000, seed), LENGTH) for seed in range(10)]
    assert np.mean(found) == pytest.approx(1, abs=0.042)


def test_clustered_points_vary_more():
    """Each point doubled: twice the variance at the same mean."""
    single = random_points(4000)
    assert count_variance(np.repeat(single, 2, axis=0), LENGTH) == pytest.approx(2, rel=0.2)
    assert np.isnan(count_variance(random_points(20), LENGTH))
