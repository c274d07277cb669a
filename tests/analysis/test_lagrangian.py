"""Lagrangian statistics of paths whose statistics are known."""

import numpy as np
import pytest

from eddies.analysis.lagrangian import (
    correlation, differences, increment_flatness, minimum_image, near_tetrads, nearest_rows, pair_dispersion, pairs_at,
    path_statistics, separations, structure_function, tetrad_moments,
)

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
