"""Lagrangian statistics of paths whose statistics are known."""

import numpy as np
import pytest

from eddies.analysis.path_statistics import differences, near_tetrads, path_statistics, tetrad_moments

LENGTH, TIMES = 2 * np.pi, 0.1 * np.arange(8)
RANDOM = np.random.default_rng(11)
START, VELOCITY = RANDOM.uniform(0, LENGTH, (3000, 3)), RANDOM.normal(size=(3000, 3))


class Paths:
    """Particles at START that move by a function of time."""

    columns = ("position", "velocity", "acceleration")
    times = TIMES + 3.0

    def __init__(self, **by_time):
        self.by_time = by_time

    def read(self, frame, column, start=0, stop=None):
        return self.by_time[column](TIMES[frame])[start:stop]


def moving(factor=1.0):
    """Each with its own constant velocity, and an acceleration that turns."""
    return Paths(position=lambda time: (START + factor * time * VELOCITY) % LENGTH,
                 velocity=lambda time: factor * VELOCITY,
                 acceleration=lambda time: factor * np.stack([np.cos(2 * time) * VELOCITY[:, 0], np.sin(2 * time)
                                                              * VELOCITY[:, 0], 0 * VELOCITY[:, 0]], axis=1))


def measured(paths, tetrads=None):
    tetrads = near_tetrads(START, LENGTH) if tetrads is None else tetrads
    return path_statistics(paths, range(len(TIMES)), tetrads, LENGTH)


def test_ballistic_particles_part_as_time_squared():
    """Velocities know nothing of places: <|dv|^2> t^2 is 6 t^2 of a pair, and R^2 grows by 3 <v^2> of each of the three
    independent differences. 1000 tetrads: the mean of 9 squares each is good to sqrt(2 / 9000)."""
    tetrads = near_tetrads(START, LENGTH)
    found = measured(moving(), tetrads)
    offsets = START[tetrads[1:]] - START[tetrads[0]]
    offsets -= LENGTH * np.rint(offsets / LENGTH)
    nearest = np.mean(np.sum(offsets[0] ** 2, axis=1))
    size = np.mean(tetrad_moments(np.concatenate([np.zeros((1, 1000, 3)), offsets]))[0])
    assert found.pair_dispersion == pytest.approx(6 * TIMES**2 / nearest, rel=0.06)
    assert found.tetrad_size[-1] == pytest.approx(1 + 9 * TIMES[-1] ** 2 / size, rel=0.05)
    assert found.times == pytest.approx(TIMES) and found.lags[0] == pytest.approx(0.1)


def test_tetrads_of_known_shape():
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    turned = np.linalg.qr(RANDOM.normal(size=(3, 3)))[0]
    size, shape = tetrad_moments(2.5 * (corners @ turned)[:, None])
    assert size == pytest.approx(4 * 3 * 2.5**2) and shape == pytest.approx(np.full((1, 3), 1 / 3))
    line = np.array([0.0, 1.0, 2.0, 5.0])[:, None, None] * turned[0]
    assert tetrad_moments(line)[1] == pytest.approx(np.array([[1, 0, 0]]), abs=1e-12)
    # Of four normal points: 0.75, 0.22, 0.03 (Pumir, Shraiman & Chertkov 2000).
    normal = tetrad_moments(RANDOM.normal(size=(4, 20000, 3)))[1].mean(axis=0)
    assert normal == pytest.approx([0.75, 0.22, 0.03], abs=0.005)


def test_accelerations_that_turn_are_forgotten_as_a_cosine():
    found = measured(moving(factor=2.0))
    assert found.acceleration_correlation == pytest.approx(np.cos(2 * found.lags), abs=1e-12)
    mean = np.array([[np.cos(2 * time), np.sin(2 * time), 0] for time in TIMES]) * 2 * VELOCITY[:, 0].mean()
    squares = 4 * np.mean(VELOCITY[:, 0] ** 2) / 3
    assert found.acceleration_variance == pytest.approx(squares - mean.sum(axis=1) ** 2 / 9)
    assert found.velocity_correlation == pytest.approx(1)


def test_paths_are_followed_through_the_faces_of_the_box():
    tetrads = near_tetrads(START, LENGTH)
    pushed = Paths(**{**moving().by_time, "position": lambda time: (START + time * (VELOCITY + 30.0)) % LENGTH})
    found, alone = measured(pushed, tetrads), measured(moving(), tetrads)
    assert found.tetrad_size == pytest.approx(alone.tetrad_size)
    assert found.tetrad_shape == pytest.approx(alone.tetrad_shape)


def test_differences_are_logarithms_of_ratios():
    truth = measured(moving())
    assert all(value == 0 for name, value in differences(truth, truth).items() if name not in (
        "structure_error", "flatness_error"))  # which a velocity that does not change has not
    faster = differences(measured(moving(np.e)), truth)
    assert faster["pair_dispersion_error"] == pytest.approx(2)
    assert faster["acceleration_variance_error"] == pytest.approx(2)
    assert faster["acceleration_correlation_error"] == pytest.approx(0, abs=1e-12)
    assert 0.5 < faster["tetrad_size_error"] < 2 and faster["tetrad_shape_error"] > 0.01


def test_one_frame_tells_nothing_of_time():
    found = differences(*2 * [path_statistics(moving(), [2], near_tetrads(START, LENGTH), LENGTH)])
    assert {name for name, value in found.items() if not np.isnan(value)} == {"acceleration_variance_error"}
