import numpy as np
import pytest

from eddies.analysis.track_splines import NO_NOISE, PARABOLA, Fit, error_weights, smooth

EDGE = 2 * np.pi
INTERVAL = 0.1


def tracks(count=40, frames=50, seed=1, interval=INTERVAL):
    """Sums of three waves along each coordinate, with a drift through the cube; their velocity is known."""
    draw = np.random.default_rng(seed)
    time = interval * np.arange(frames)
    rates, phases = draw.uniform(0.5, 2.5, (3, count, 1, 3)), draw.uniform(0, 2 * np.pi, (3, count, 1, 3))
    start, drift = draw.uniform(0, EDGE, (count, 1, 3)), draw.uniform(-1, 1, (count, 1, 3))
    angle = rates * time[:, None] + phases
    position = start + drift * time[:, None] + np.sum(np.sin(angle), 0)
    velocity = drift + np.sum(rates * np.cos(angle), 0)
    return np.tile(time, count), np.repeat(np.arange(count), frames), position.reshape(-1, 3), velocity.reshape(-1, 3)


def error(found, true):
    return np.sqrt(np.mean((found - true) ** 2) / np.mean(true**2))


@pytest.mark.parametrize("frames, smoothing", [(3, 1.0), (200, 10.0)])
def test_the_noise_of_velocities_is_that_of_splines_of_noise(frames, smoothing):
    """Three rows give a parabola: the velocity at its ends has the variance 26/4, in its middle 1/2, over h^2. For
    long tracks 32 sets of random errors give the sum to 2 %. The test has 2000 sets, which are more exact; for three
    rows they give the sum to 2 % too."""
    time = INTERVAL * np.arange(frames)
    fit = Fit(time, np.zeros((1, frames, 3)), INTERVAL)
    found = fit.velocity_errors(smoothing, time)[:, 0].sum() * INTERVAL**2
    if frames == 3:
        assert found == pytest.approx(2 * 26 / 4 + 1 / 2)
    draws = np.random.default_rng(3).standard_normal((frames, 2000))
    direct = np.mean(fit.spline(smoothing, draws).derivative()(time) ** 2, axis=1).sum() * INTERVAL**2
    assert found == pytest.approx(direct, rel=0.04)


@pytest.mark.parametrize("frames", [20, 60])
def test_velocities_have_errors_of_noise_and_of_smoothing(frames):
    """3000 motions whose jerk is white noise. In their middle the smoothing of the motion is a quarter of the error.

    For 60 frames 32 sets of random data give the sum, most of which is at both ends, to 25 %."""
    smoothing, draw = 100.0, np.random.default_rng(4)
    time, jerks = INTERVAL * np.arange(frames), draw.standard_normal((frames - 1, 3000)) / np.sqrt(smoothing)
    state = np.zeros((3, 3000))  # position, velocity and acceleration, in units of the interval
    motion = [state]
    for jerk in jerks:
        x, v, a = state
        state = np.stack([x + v + a / 2 + jerk / 6, v + a + jerk / 2, a + jerk])
        motion.append(state)
    position, velocity = np.array(motion)[:, 0], np.array(motion)[:, 1] / INTERVAL
    fit = Fit(time, np.zeros((1, frames, 3)), INTERVAL)
    found = fit.spline(smoothing, position + draw.standard_normal(position.shape)).derivative()(time)
    squares, errors = np.mean((found - velocity) ** 2, axis=1), fit.velocity_errors(smoothing, time)
    assert squares[0] > 5 * squares[frames // 2] and 0.1 < errors[frames // 2, 1] / squares[frames // 2] < 0.5
    if frames == 20:
        np.testing.assert_allclose(errors.sum(1), squares, rtol=0.15)  # of 3000 motions: five standard deviations
    assert errors.sum() == pytest.approx(squares.sum(), rel=0.05 if frames == 20 else 0.5)


@pytest.mark.parametrize("smoothing", [1e-6, 1.0, 100.0])
def test_errors_of_successive_velocities_are_those_of_shared_positions(smoothing):
    """Splines of random positions, in the middle of 61 rows. The tolerance is five standard deviations of a correlation
    of 4000 numbers."""
    weights, rows = error_weights(smoothing, 61), np.arange(61.0)
    draws = np.random.default_rng(5).standard_normal((61, 4000))
    found = Fit(rows, np.zeros((1, 61, 3)), 1.0).spline(smoothing, draws).derivative()(rows[26:36])
    together = np.correlate(weights, weights, "full")[len(weights) - 1:]
    expected = np.append(together, np.zeros(10))[1:10]
    np.testing.assert_allclose(np.corrcoef(found)[0, 1:], expected, atol=5 / 63)


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
    # Without smoothing all of the error is noise.
    assert np.sqrt(untreated.velocity_errors[:, 0].mean()) * noise == pytest.approx(
        np.sqrt(np.mean((untreated.velocity - velocity[untreated.rows]) ** 2)), rel=0.05)


@pytest.mark.parametrize("factor", [0.1, 0.98, 1.0])
@pytest.mark.parametrize("interval, frames, noise, most", [(0.001, 400, 5e-3, 0.012), (0.1, 50, 5e-3, 0.02)])
def test_fast_and_slow_cameras_need_different_smoothing(interval, frames, noise, most, factor):
    """The bounds are 1.5 times the least error of any mu. A noise that is given too small does no harm."""
    time, track, position, velocity = tracks(frames=frames, interval=interval)
    noisy = position + noise * np.random.default_rng(2).standard_normal(position.shape)
    found = smooth(time, track, noisy, EDGE, factor * noise)
    assert error(found.velocity, velocity[found.rows]) < most
    assert found.residual == pytest.approx(noise, rel=0.05)  # sampling errors are 0.4 to 1 %, and splines miss a little


@pytest.mark.parametrize("noise", [1e-3, 1e-2, 5e-2])
@pytest.mark.parametrize("frames", [10, 50])
def test_noise_is_estimated_and_velocities_are_those_of_a_given_noise(frames, noise):
    """The residuals of forty tracks of ten frames leave about 600 degrees of freedom, and an error of 3 %; the truth
    has a part that splines miss."""
    time, track, position, velocity = tracks(frames=frames)
    noisy = position + noise * np.random.default_rng(2).standard_normal(position.shape)
    found, given = smooth(time, track, noisy, EDGE, None), smooth(time, track, noisy, EDGE, noise)
    assert found.residual == pytest.approx(noise, rel=0.2 if noise == 1e-3 else 0.06)
    assert error(found.velocity, velocity[found.rows]) < 1.05 * error(given.velocity, velocity[given.rows])


def test_tracks_without_noise_are_not_smoothed_when_it_is_estimated():
    time, track, position, _ = tracks()
    found = smooth(time, track, position, EDGE, None)
    assert found.smoothing == NO_NOISE and found.residual < 1e-5


def test_gaps_are_filled_with_the_rows_of_the_splines():
    time, track, position, velocity = tracks()
    frame = np.rint(time / INTERVAL)
    there = np.flatnonzero(~np.isin(frame, (0, 20, 21, 35)) | (track % 2 == 0))
    found = smooth(time[there], track[there], position[there], EDGE, fill=INTERVAL)
    order = np.lexsort((found.time, found.track))
    expected = (frame > 0) | (track % 2 == 0)  # a track is not continued beyond its ends
    np.testing.assert_array_equal(found.track[order], track[expected])
    np.testing.assert_allclose(found.time[order], time[expected], atol=1e-12)
    np.testing.assert_array_equal(found.rows[order] < 0, np.isin(frame, (20, 21, 35))[expected] & (track % 2)[expected])
    filled = found.rows[order] < 0
    assert 0 < error(found.velocity[order][filled], velocity[expected][filled]) < 3e-3  # 0.0018 for two frames
    known = found.rows[~(found.rows < 0)]
    np.testing.assert_allclose(found.position[found.rows >= 0], position[there][known], atol=1e-4)


@pytest.mark.parametrize("frames", [4, 50, 2000])
def test_the_limit_of_strong_smoothing_is_the_parabola_of_least_squares(frames):
    draw = np.random.default_rng(4)
    time = np.cumsum(draw.uniform(0.5, 1.5, frames)) * 1e-3
    positions = 3 + np.sin(3 * time / time[-1])[None, :, None] + 0.1 * draw.standard_normal((2, frames, 3))
    fit = Fit(time, positions, 1e-3)
    values = positions.transpose(1, 0, 2).reshape(frames, -1)
    basis = np.stack([time**0, time / time[-1], (time / time[-1]) ** 2], 1)
    parabola = (basis @ np.linalg.lstsq(basis, values, rcond=None)[0]).reshape(frames, 2, 3).transpose(1, 0, 2)
    for smoothing in (PARABOLA * float(frames) ** 6, 1e200):
        # Round-off of third differences, integrated three times, grows with the cube of the number of rows.
        np.testing.assert_allclose(next(fit.derivatives(smoothing, time)), parabola.reshape(-1, 3), rtol=0, atol=1e-7)
    assert fit.residual(1e200)[2] / 6 == pytest.approx(frames - 3, abs=1e-4)


def test_tracks_with_more_noise_than_they_show_become_parabolas():
    time, track, position, _ = tracks(frames=20)
    found = smooth(time, track, position, EDGE, noise=10.0)
    assert 0 < found.residual < 10.0
    jerk = np.diff(found.position.reshape(40, 20, 3), 3, axis=1)
    assert np.abs(jerk).max() < 1e-6


def test_tracks_of_three_rows_have_no_residuals():
    found = smooth(np.tile([0.0, 0.1, 0.2], 2), np.repeat([0, 1], 3), np.arange(18.0).reshape(6, 3), None, 0.1)
    assert np.isnan(found.residual)
    np.testing.assert_allclose(found.velocity, 30, rtol=1e-6)


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
