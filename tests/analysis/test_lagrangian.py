import numpy as np
import pytest

from eddies.analysis.lagrangian import (
    minimum_image, pair_dispersion, structure_function, unwrapped, velocity_autocorrelation,
)

LENGTH = 2 * np.pi


def test_turning_velocities_are_forgotten_as_a_cosine():
    time = np.linspace(0, 3, 13)
    phase = np.random.default_rng(9).uniform(0, LENGTH, 200)
    angle = phase[None, :] + 1.7 * time[:, None]
    velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    assert velocity_autocorrelation(velocity) == pytest.approx(np.cos(1.7 * time))
    assert velocity_autocorrelation(5 * velocity)[0] == pytest.approx(1)
    lags = np.array([0, 1, 4])
    assert structure_function(velocity, lags) == pytest.approx(2 * (1 - np.cos(1.7 * time[lags])) / 3)


def test_paths_through_the_faces_are_continuous():
    time = np.linspace(0, 10, 41)
    path = np.array([[0.1, 6.0, 3.0]]) + time[:, None, None] * np.array([[1.5, -2.0, 0.3]])
    assert np.allclose(unwrapped(path % LENGTH, LENGTH), path)


def test_pairs_that_part_at_constant_velocity():
    time = np.linspace(0, 4, 21)
    velocity = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, -1.0]])
    position = np.array([[1.0, 2.0, 3.0]] * 3) + time[:, None, None] * velocity
    dispersion = pair_dispersion(position % LENGTH, np.array([0, 1]), np.array([1, 2]), LENGTH)
    assert np.allclose(dispersion, 2 * time**2)


def test_minimum_image():
    displacement = np.array([LENGTH - 0.1, -LENGTH + 0.2, 0.3])
    assert minimum_image(displacement, LENGTH) == pytest.approx([-0.1, 0.2, 0.3])
