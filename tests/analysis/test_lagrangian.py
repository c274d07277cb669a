import numpy as np
import pytest

from eddies.analysis.lagrangian import (
    correlation, increment_flatness, minimum_image, nearest_rows, pair_dispersion, pairs_at, separations,
    structure_function,
)

LENGTH = 2 * np.pi


def test_turning_velocities_are_forgotten_as_a_cosine():
    time = np.linspace(0, 3, 13)
    phase = np.random.default_rng(9).uniform(0, LENGTH, 200)
    angle = phase[None, :] + 1.7 * time[:, None]
    velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    found = [correlation(velocity[0], frame) for frame in velocity]
    assert found == pytest.approx(np.cos(1.7 * time))
    assert correlation(velocity[0], 5 * velocity[0]) == pytest.approx(1)
    lags = np.array([0, 1, 4])
    assert structure_function(velocity, lags) == pytest.approx(2 * (1 - np.cos(1.7 * time[lags])) / 3)


def test_the_structure_function_counts_all_start_frames():
    velocity = np.array([0.0, 0.0, 3.0, 3.0])[:, None, None] * np.ones((1, 5, 3))
    assert structure_function(velocity, np.array([1, 2, 3])) == pytest.approx([3.0, 9.0, 9.0])


def test_separations_of_pairs_that_leave_through_the_faces_are_continuous():
    time = np.linspace(0, 10, 41)
    start, velocity = np.array([[0.1, 6.0, 3.0], [6.2, 0.3, 3.0]]), np.array([[1.5, -2.0, 0.3], [-1, 0.5, 0]])
    path = start + time[:, None, None] * velocity
    found = np.array(list(separations(path % LENGTH, np.array([0]), np.array([1]), LENGTH)))
    assert np.allclose(found[0], [[0.1 - 6.2 + LENGTH, 6.0 - 0.3 - LENGTH, 0.0]])  # the nearest image
    assert np.allclose(found - found[0], (path[:, :1] - path[:, 1:]) - (path[0, :1] - path[0, 1:]))


@pytest.mark.parametrize("shift", [0.0, -0.7, LENGTH], ids=["in the box", "across a face", "in the next box"])
def test_pairs_at_a_distance_are_all_of_them_once(shift):
    position = (np.random.default_rng(4).uniform(0, LENGTH, (300, 3)) + shift).astype(np.float32)
    distances = (0.5, 2.0, 3.0)  # of the last one, pairs are up to more than half a box apart
    found = pairs_at(position, LENGTH, distances, 0.1, followed=40)
    apart = np.linalg.norm(minimum_image(position[:40, None] - position[None], LENGTH), axis=-1)
    apart[np.tril_indices(40)] = np.inf
    for distance, pairs in zip(distances, found):
        assert np.array_equal(pairs, np.nonzero(np.abs(apart - distance) <= 0.1 * distance))
    assert pairs_at(position, LENGTH, [1e-6], 0.1, followed=40)[0].shape == (2, 0)


def test_pairs_that_part_at_constant_velocity():
    time = np.linspace(0, 4, 21)
    velocity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    position = np.array([[1.0, 2.0, 3.0]] * 3) + time[:, None, None] * velocity
    dispersion, = pair_dispersion(position % LENGTH, [np.array([[0, 1], [1, 2]])], LENGTH)
    assert np.allclose(dispersion, 2 * time**2)


def test_increments_of_normal_velocities_have_flatness_three():
    """Of a random walk at every lag; the deviation of a flatness of 60000 values is sqrt(96 / 60000) = 0.04. Waves of
    one amplitude, whose increments are sines, have 3/2."""
    walk = np.cumsum(np.random.default_rng(5).normal(size=(6, 20000, 3)), axis=0)
    assert increment_flatness(walk, np.array([1, 3, 5])) == pytest.approx(3, abs=0.12)
    phase = LENGTH * np.arange(1000) / 1000
    waves = np.stack([np.sin(phase + 0.4 * step) for step in range(4)])[..., None]
    assert increment_flatness(waves, np.array([1, 2])) == pytest.approx(1.5)
    assert np.isnan(increment_flatness(np.ones((2, 5, 3)), np.array([1]))).all()


@pytest.mark.parametrize("spread", [LENGTH, 0.3], ids=["even", "in a corner"])
def test_nearest_rows_are_those_of_all_distances(spread):
    """Two in one place, and one that may be far from all others."""
    position = np.random.default_rng(4).uniform(0, spread, (200, 3))
    position[7], position[0] = position[3], 3.0
    chosen = np.array([7, 0, 199])
    apart = np.linalg.norm(minimum_image(position[chosen][:, None] - position[None], LENGTH), axis=-1)
    apart[np.arange(3), chosen] = np.inf
    assert np.array_equal(nearest_rows(position, LENGTH, chosen, 3), np.argsort(apart, axis=1)[:, :3].T)
    with pytest.raises(ValueError, match="none has 3 neighbours"):
        nearest_rows(position[:3], LENGTH, np.array([0]), 3)


def test_minimum_image():
    displacement = np.array([LENGTH - 0.1, -LENGTH + 0.2, 0.3])
    assert minimum_image(displacement, LENGTH) == pytest.approx([-0.1, 0.2, 0.3])
