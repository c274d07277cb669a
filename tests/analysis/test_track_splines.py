import numpy as np

from eddies.analysis.track_splines import NO_NOISE, smooth

EDGE = 2 * np.pi
INTERVAL = 0.1


def tracks(count=40, frames=50, seed=1):
    """Sums of three waves along each coordinate, with a drift through the cube; their velocity is known."""
    draw = np.random.default_rng(seed)
    time = INTERVAL * np.arange(frames)
    rates, phases = draw.uniform(0.5, 2.5, (3, count, 1, 3)), draw.uniform(0, 2 * np.pi, (3, count, 1, 3))
    start, drift = draw.uniform(0, EDGE, (count, 1, 3)), draw.uniform(-1, 1, (count, 1, 3))
    angle = rates * time[:, None] + phases
    position = start + drift * time[:, None] + np.sum(np.sin(angle), 0)
    velocity = drift + np.sum(rates * np.cos(angle), 0)
    return np.tile(time, count), np.repeat(np.arange(count), frames), position.reshape(-1, 3), velocity.reshape(-1, 3)


def error(found, true):
    return np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))


def test_velocities_of_smooth_tracks_without_noise():
    time, track, position, velocity = tracks()
    found = smooth(time, track, position % EDGE, EDGE)
    assert found.smoothing == NO_NOISE
    rows = found.rows
    moved = found.position - position[rows]
    np.testing.assert_allclose(moved, EDGE * np.rint(moved / EDGE), atol=1e-4)
    # Cubic splines: errors of third order in omega h = 0.25, largest at the ends.
    assert error(found.velocity, velocity[rows]) < 2e-3


def test_errors_fall_with_the_order_of_cubic_splines():
    errors = []
    for every in (2, 1):
        time, track, position, velocity = (part.reshape(40, 50, *part.shape[1:])[:, ::every].reshape(
            -1, *part.shape[1:]) for part in tracks())
        found = smooth(time, track, position, EDGE)
        errors.append(error(found.velocity, velocity[found.rows]))
    assert np.log2(errors[0] / errors[1]) > 2.5


def test_noise_is_removed_and_its_strength_sets_the_smoothing():
    time, track, position, velocity = tracks()
    noise = 0.05
    noisy = position + noise * np.random.default_rng(2).standard_normal(position.shape)
    found, untreated = smooth(time, track, noisy, EDGE, noise), smooth(time, track, noisy, EDGE)
    rows = found.rows
    kept = np.sqrt(np.mean((found.position - position[rows]) ** 2))
    assert kept < 0.6 * noise  # a filter with a cut-off at a third of the frequencies leaves 0.58 of white noise
    assert error(found.velocity, velocity[rows]) < 0.25 * error(untreated.velocity, velocity[untreated.rows])


def test_tracks_begin_and_end_and_have_gaps():
    time, track, position, velocity = tracks()
    draw = np.random.default_rng(3)
    lengths = draw.integers(1, 50, 40)
    there = (np.tile(np.arange(50), 40) < lengths[track]) & (draw.random(len(time)) > 0.05)
    shuffled = draw.permutation(np.flatnonzero(there))
    found = smooth(time[shuffled], track[shuffled], position[shuffled] % EDGE, EDGE)
    used = shuffled[found.rows]
    rows = np.bincount(track[there], minlength=40)
    assert sorted(used) == list(np.flatnonzero(there & (rows[track] >= 3)))
    middle = (time[used] > 0.5) & (time[used] < (lengths[track[used]] - 6) * INTERVAL)
    assert error(found.velocity[middle], velocity[used][middle]) < 0.02


def test_a_parabola_is_exact_even_with_the_strongest_smoothing():
    time = np.array([0.0, 0.1, 0.25, 0.3, 0.5])
    position = 0.2 + np.outer(time, [0.3, 0.1, -0.2]) + np.outer(time**2, [1, 0.5, 2])
    found = smooth(time, np.zeros(5, int), position, EDGE, noise=10.0)
    np.testing.assert_allclose(found.velocity, np.outer(np.ones(5), [0.3, 0.1, -0.2]) + np.outer(time, [2, 1, 4]),
                               atol=1e-6)


def test_tracks_that_are_too_short_leave_nothing():
    found = smooth(np.array([0.0, 0.1]), np.zeros(2, int), np.zeros((2, 3)), EDGE)
    assert len(found.rows) == len(found.velocity) == 0
