"""Lagrangian statistics of paths with known statistics."""

import numpy as np
import pytest

from eddies.analysis.lagrangian import (
    correlation, differences, increment_flatness, minimum_image, near_tetrads, pairs_at, path_statistics,
    structure_function, tetrad_moments,
)

LENGTH, TIMES = 2 * np.pi, 0.1 * np.arange(8)
RANDOM = np.random.default_rng(11)
START, VELOCITY = RANDOM.uniform(0, LENGTH, (3000, 3)), RANDOM.normal(size=(3000, 3))
TETRADS = near_tetrads(START, LENGTH)


class Paths:
    """Particles from START with constant velocities and accelerations that turn."""

    columns, times, length = ("position", "velocity", "acceleration"), TIMES + 3.0, LENGTH

    def __init__(self, factor=1.0, wind=0.0):
        self.factor, self.wind = factor, wind

    def read(self, frame, column, start=0, stop=None):
        time = TIMES[frame]
        turning = np.stack([np.cos(2 * time) * VELOCITY[:, 0], np.sin(2 * time) * VELOCITY[:, 0], 0 * VELOCITY[:, 0]],
                           axis=1)
        return {"position": (START + time * (self.factor * VELOCITY + self.wind)) % LENGTH,
                "velocity": self.factor * VELOCITY, "acceleration": self.factor * turning}[column][start:stop]


def measured(paths):
    return path_statistics(paths, range(len(TIMES)), TETRADS)


def test_ballistic_particles_part_as_time_squared():
    """Velocities do not depend on positions: <|dv|^2> t^2 of a pair is 6 t^2, and R^2 of a tetrad grows by 9 t^2. The
    mean of 9 squares each of 1000 tetrads is good to sqrt(2 / 9000)."""
    found, offsets = measured(Paths()), minimum_image(START[TETRADS] - START[TETRADS[0]], LENGTH)
    assert found.pair_dispersion == pytest.approx(6 * TIMES**2 / np.mean(np.sum(offsets[1] ** 2, axis=1)), rel=0.06)
    assert found.tetrad_size[-1] == pytest.approx(1 + 9 * TIMES[-1] ** 2 / tetrad_moments(offsets)[0].mean(), rel=0.05)
    assert found.times == pytest.approx(TIMES) and found.lags[0] == pytest.approx(0.1)
    # Paths are followed through the faces of the box.
    blown = measured(Paths(wind=30.0))
    assert blown.tetrad_size == pytest.approx(found.tetrad_size)
    assert blown.tetrad_shape == pytest.approx(found.tetrad_shape)


def test_tetrads_of_known_shape():
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float)
    turned = np.linalg.qr(RANDOM.normal(size=(3, 3)))[0]
    size, shape = tetrad_moments(2.5 * (corners @ turned)[:, None])
    assert size == pytest.approx(4 * 3 * 2.5**2) and shape == pytest.approx(np.full((1, 3), 1 / 3))
    line = np.array([0.0, 1.0, 2.0, 5.0])[:, None, None] * turned[0]
    assert tetrad_moments(line)[1] == pytest.approx(np.array([[1, 0, 0]]), abs=1e-12)
    # Four normal points: 0.75, 0.22, 0.03 (Pumir, Shraiman & Chertkov 2000).
    normal = tetrad_moments(RANDOM.normal(size=(4, 20000, 3)))[1].mean(axis=0)
    assert normal == pytest.approx([0.75, 0.22, 0.03], abs=0.005)


def test_accelerations_that_turn_lose_their_correlation_as_a_cosine():
    found = measured(Paths(factor=2.0))
    assert found.acceleration_correlation == pytest.approx(np.cos(2 * found.lags), abs=1e-12)
    assert found.acceleration_variance[0] == pytest.approx(4 * np.var(np.pad(VELOCITY[:, :1], ((0, 0), (0, 2)))))
    assert found.velocity_correlation == pytest.approx(1)


def test_differences_are_logarithms_of_ratios():
    truth = measured(Paths())
    # A constant velocity has no increments.
    assert all(value == 0 for name, value in differences(truth, truth).items() if name not in (
        "structure_error", "flatness_error"))
    faster = differences(measured(Paths(np.e)), truth)
    assert faster["pair_dispersion_error"] == pytest.approx(2)
    assert faster["acceleration_variance_error"] == pytest.approx(2)
    assert faster["acceleration_correlation_error"] == pytest.approx(0, abs=1e-12)
    assert 0.5 < faster["tetrad_size_error"] < 2 and faster["tetrad_shape_error"] > 0.01
    alone = path_statistics(Paths(), [2], TETRADS)
    assert {name for name, value in differences(alone, alone).items() if not np.isnan(value)} == {
        "acceleration_variance_error"}


def test_turning_velocities():
    time = np.linspace(0, 3, 13)
    phase = np.random.default_rng(9).uniform(0, LENGTH, 200)
    angle = phase[None, :] + 1.7 * time[:, None]
    velocity = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    found = [correlation(velocity[0], frame) for frame in velocity]
    assert found == pytest.approx(np.cos(1.7 * time))
    assert correlation(velocity[0], 5 * velocity[0]) == pytest.approx(1)
    lags = np.array([0, 1, 4])
    assert structure_function(velocity, lags) == pytest.approx(2 * (1 - np.cos(1.7 * time[lags])) / 3)
    # The mean is over all start frames.
    jump = np.array([0.0, 0.0, 3.0, 3.0])[:, None, None] * np.ones((1, 5, 3))
    assert structure_function(jump, np.array([1, 2, 3])) == pytest.approx([3.0, 9.0, 9.0])


@pytest.mark.parametrize("shift", [0.0, -0.7, LENGTH], ids=["in the box", "across a face", "in the next box"])
def test_all_pairs_at_a_distance(shift):
    position = (np.random.default_rng(4).uniform(0, LENGTH, (300, 3)) + shift).astype(np.float32)
    distances = (0.5, 2.0, 3.0)  # with the tolerance up to more than half a box
    found = pairs_at(position, LENGTH, distances, 0.1, followed=40)
    apart = np.linalg.norm(minimum_image(position[:40, None] - position[None], LENGTH), axis=-1)
    apart[np.tril_indices(40)] = np.inf
    for distance, pairs in zip(distances, found):
        assert np.array_equal(pairs, np.nonzero(np.abs(apart - distance) <= 0.1 * distance))
    assert pairs_at(position, LENGTH, [1e-6], 0.1, followed=40)[0].shape == (2, 0)


def test_increments_of_normal_velocities_have_flatness_three():
    """The standard deviation of a flatness of 60000 values is sqrt(96 / 60000) = 0.04. Sines have 3/2."""
    walk = np.cumsum(np.random.default_rng(5).normal(size=(6, 20000, 3)), axis=0)
    assert increment_flatness(walk, np.array([1, 3, 5])) == pytest.approx(3, abs=0.12)
    phase = LENGTH * np.arange(1000) / 1000
    waves = np.stack([np.sin(phase + 0.4 * step) for step in range(4)])[..., None]
    assert increment_flatness(waves, np.array([1, 2])) == pytest.approx(1.5)
    assert np.isnan(increment_flatness(np.ones((2, 5, 3)), np.array([1]))).all()


@pytest.mark.parametrize("spread", [LENGTH, 0.3], ids=["even", "in a corner"])
def test_tetrads_are_a_particle_and_its_three_nearest(spread):
    """One particle may be far from all others."""
    position = np.random.default_rng(4).uniform(0, spread, (200, 3))
    position[0] = 3.0
    apart = np.linalg.norm(minimum_image(position[:, None] - position[None], LENGTH), axis=-1)
    assert np.array_equal(near_tetrads(position, LENGTH), np.argsort(apart, axis=1)[:, :4].T)
    with pytest.raises(ValueError, match="3 particles"):
        near_tetrads(position[:3], LENGTH)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("together", [4, 3000])
def test_particles_at_the_same_place_have_no_shape_and_spoil_no_mean(together, monkeypatch):
    """Groups of four whose members stay together: one among others, or all particles. No warning reaches the user."""
    places, moves = START.copy(), VELOCITY.copy()
    for values in (places, moves):
        values[:together] = values[:together:4].repeat(4, axis=0)
    tetrads = np.concatenate([np.arange(together).reshape(-1, 4).T, TETRADS[:, :100 if together == 4 else 0]], axis=1)
    monkeypatch.setitem(globals(), "START", places)
    monkeypatch.setitem(globals(), "VELOCITY", moves)
    found = path_statistics(Paths(), range(len(TIMES)), tetrads)
    for values in (found.pair_dispersion, found.tetrad_size, found.tetrad_shape):
        assert (np.isfinite(values) if together == 4 else np.isnan(values)).all()
    assert together > 4 or found.tetrad_shape.sum(axis=1) == pytest.approx(np.ones(len(TIMES)))
