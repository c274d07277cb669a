import numpy as np
import pytest

from eddies.analysis.lagrangian import (
    minimum_image, pair_dispersion, pairs_at, separations, structure_function, velocity_correlation,
)

LENGTH = 2 * np.pi


def test_turning_velocities_are_forgotten_as_a_cosine():
    time = np.linspace(0, 3, 13)
    phase = np.random.default_rng(9).uniform(0, LENGTH, 200)
    angle = phase[None, :] + 1.7 * time[:, None]
    velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    correlation = [velocity_correlation(velocity[0], frame) for frame in velocity]
    assert correlation == pytest.approx(np.cos(1.7 * time))
    assert velocity_correlation(velocity[0], 5 * velocity[0]) == pytest.approx(1)
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


def test_pairs_at_a_distance_are_all_of_them_once():
    position = np.random.default_rng(4).uniform(0, LENGTH, (300, 3))
    found = pairs_at(position, LENGTH, [0.5, 2.0], 0.1, followed=40)
    apart = np.linalg.norm(minimum_image(position[:40, None] - position[None], LENGTH), axis=-1)
    apart[np.tril_indices(40)] = np.inf
    for distance, pairs in zip((0.5, 2.0), found):
        assert np.array_equal(pairs, np.nonzero(np.abs(apart - distance) <= 0.1 * distance))
    assert pairs_at(position, LENGTH, [1e-6], 0.1, followed=40)[0].shape == (2, 0)


def test_pairs_that_part_at_constant_velocity():
    time = np.linspace(0, 4, 21)
    velocity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    position = np.array([[1.0, 2.0, 3.0]] * 3) + time[:, None, None] * velocity
    dispersion, = pair_dispersion(position % LENGTH, [np.array([[0, 1], [1, 2]])], LENGTH)
    assert np.allclose(dispersion, 2 * time**2)


def test_minimum_image():
    displacement = np.array([LENGTH - 0.1, -LENGTH + 0.2, 0.3])
    assert minimum_image(displacement, LENGTH) == pytest.approx([-0.1, 0.2, 0.3])
