"""Velocities along measured tracks, by smoothing splines.

Each track is approximated by a cubic spline s(t) with a knot at each time t_i of the track. The spline minimises

    sum_i |x_i - s(t_i)|^2 + mu h^5 int |s'''|^2 dt,    h the median interval of all tracks.

x_i are the measured positions. This estimate assumes that their errors have equal variance, and that the jerk, the
third derivative of the true position, is white noise (TrackFit; Gesemann, Huhn, Schanz and Schröder 2016). The spline
damps angular frequencies above mu^(-1/6) / h. It needs no condition at the ends of a track. For large mu it is a
parabola, fitted by least squares.

If the variance is not known, mu minimises the error of generalised cross-validation, n RSS / tr(R)^2, and the variance
is RSS / tr(R) (Wahba 1983). RSS is the sum of the n squared residuals, R the matrix that maps positions to residuals.

The error of a spline has two parts: what is left of the errors of positions, and what smoothing removes from the
motion. If the jerk is white noise with the variance s^2 / (mu h^6) in each interval, where s^2 is the variance of a
position, the spline is the mean of the motions that fit. Both parts are then the splines of random data: of positions
with the variance s^2, and of jerks, which are to be found again at positions of zero.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from math import ceil

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solve_banded
from scipy.optimize import brentq
from scipy.sparse import coo_array

DEGREE, LEAST_ROWS = 3, 3   # degree of a spline; fewest rows that determine a parabola, which has no jerk
WIDTH = 2 * DEGREE          # diagonals on each side of that of the equations
NO_NOISE = 1e-6             # smallest mu, which damps no frequency that the frames resolve
PARABOLA = 1e3              # mu divided by the sixth power of the number of rows, for which a spline is a parabola
TRIED = 300                 # about the number of tracks from which mu is determined
BLOCK = 256                 # columns of an influence matrix that are computed at a time
EQUAL = 1e-6                # fraction of the interval below which times of tracks are the same
FAR = 6                     # rows to each side that count for a velocity, divided by 1 + mu^(1/6)
RANDOM = 32                 # sets of random errors that stand for those of tracks with more rows


@dataclass(frozen=True)
class SmoothedTracks:
    """Rows of tracks after smoothing.

    Parameters
    ----------
    rows : for each row, its row number in the arguments of `smooth`; -1 for a row at a time that the track lacks.
        Tracks with fewer than three rows are left out.
    time, track : time and number of the track, (rows,).
    position, velocity : (rows, 3). Positions are continuous along a track.
    velocity_errors : (rows, 2), variances of the error of a velocity component, for errors of positions of variance 1:
        of what is left of these errors, and of what smoothing removes from the motion.
    error_weights : those of the longest track.
    smoothing : mu of the splines.
    residual : noise that the residuals of the longest tracks show. It is the given noise if a mu fits it, and the
        estimate if none is given. It is NaN without noise, and for tracks of three rows, which have no residuals.
    """

    rows: np.ndarray
    time: np.ndarray
    track: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    velocity_errors: np.ndarray
    error_weights: np.ndarray
    smoothing: float
    residual: float


def smooth(time: np.ndarray, track: np.ndarray, position: np.ndarray, edge: float | None,
           noise: float | None = 0.0, fill: float | None = None) -> SmoothedTracks:
    """Return tracks after smoothing by splines.

    Parameters
    ----------
    time, track : time of each row and number of its track, (rows,). Rows are in any order.
    position : (rows, 3), wrapped into the cube or not.
    edge : edge of a periodic cube, or None. Particles must move by less than half an edge between rows of a track.
    noise : standard deviation of the error of a measured coordinate. It determines mu: the squared residuals are then
        those that independent errors of this deviation leave. If it is 0, mu is NO_NOISE. If no mu fits it, `residual`
        of the result differs from it. If it is None, it is estimated.
    fill : interval of frames. The result then has rows at all frames between the first and the last of a track. None:
        it has the times of the track.
    """
    order = np.lexsort((time, track))
    steps, within = np.diff(time[order]), np.diff(track[order]) == 0
    if not within.any():
        nothing = np.zeros((0, 3))
        return SmoothedTracks(np.zeros(0, int), np.zeros(0), np.zeros(0, int), nothing, nothing, nothing[:, :2],
                              error_weights(NO_NOISE, LEAST_ROWS), NO_NOISE, np.nan)
    interval = float(np.median(steps[within]))
    ends = np.append(np.flatnonzero(~within) + 1, len(order))
    alike: dict[bytes, list[np.ndarray]] = defaultdict(list)
    for start, stop in zip([0, *ends[:-1]], ends):
        if stop - start >= LEAST_ROWS:
            rows = order[start:stop]
            alike[np.rint((time[rows] - time[rows[0]]) / (EQUAL * interval)).tobytes()].append(rows)
    groups = [np.array(rows) for rows in alike.values()]
    if not groups:
        return smooth(time[:1], track[:1], position[:1], edge)
    fits = [Fit(time[rows[0]] - time[rows[0, 0]], _unwrapped(position[rows], edge), interval) for rows in groups]
    smoothing, residual = (NO_NOISE, np.nan) if noise == 0 else _smoothing_of(fits, noise)
    parts = [_sampled(fit, smoothing, rows, time[rows[:, 0]], track[rows[:, 0]], fill)
             for fit, rows in zip(fits, groups)]
    weights = error_weights(smoothing, max(len(fit.times) for fit in fits))
    return SmoothedTracks(*map(np.concatenate, zip(*parts)), weights, smoothing, residual)


def error_weights(smoothing: float, rows: int) -> np.ndarray:
    """Return weights of successive positions. The sum of the errors of these positions with the weights is the error of
    the velocity of a spline in the middle of a track with this number of rows, up to a factor.

    The sum of the squared weights is 1. Their autocorrelation is that of the errors of successive velocities. Rows that
    are far for a spline with mu = `smoothing` have no weight.
    """
    rows = min(rows, 2 * ceil(FAR * (1 + smoothing ** (1 / 6))) + 1)
    fit = Fit(np.arange(float(rows)), np.zeros((1, rows, 3)), 1.0)
    weights = fit.spline(smoothing, np.eye(rows)).derivative()(rows // 2)
    return weights / np.linalg.norm(weights)


def _sampled(fit: Fit, smoothing: float, rows: np.ndarray, start: np.ndarray, track: np.ndarray,
             fill: float | None) -> tuple[np.ndarray, ...]:
    """Return the first six arrays of `SmoothedTracks` for the tracks of a fit, which begin at `start` (tracks,).
    `rows` (tracks, n) holds their row numbers."""
    times = fit.times
    if fill is not None:
        frames = np.rint(times / fill).astype(int)
        times = fill * np.arange(frames[-1] + 1)
        rows, known = np.full((len(rows), len(times)), -1), rows
        rows[:, frames] = known
    return (rows.ravel(), np.add.outer(start, times).ravel(), np.repeat(track, len(times)),
            *fit.derivatives(smoothing, times), np.tile(fit.velocity_errors(smoothing, times), (len(rows), 1)))


class Fit:
    """The splines of tracks with the same times (n,).

    `positions` is (tracks, n, 3). `interval` is h, the median interval of all tracks.

    The coefficients c of a spline minimise |x - B c|^2 + mu |J c|^2. With l = mu J c this is

        B^T B c + J^T l = B^T x,   J c - l / mu = 0,

    which is well conditioned for any mu; the equations without l are not for large mu. c_j is unknown 2 j and l_k is
    unknown 2 k + 3, so that the matrix has few diagonals. Unknowns 1 and 2 n + 1 are not used.
    """

    def __init__(self, times: np.ndarray, positions: np.ndarray, interval: float) -> None:
        self.times, self.tracks = times, len(positions)
        self._values = np.moveaxis(positions, 1, 0).reshape(len(times), -1)
        before, after = times[0] - times[1], times[-1] - times[-2]
        steps = np.arange(1, DEGREE + 1)
        self._knots = np.concatenate([times[0] + before * steps[::-1], times, times[-1] + after * steps])
        self._basis = BSpline.design_matrix(times, self._knots, DEGREE)
        unit = BSpline(self._knots, np.eye(len(times) + DEGREE - 1), DEGREE)
        weight = np.sqrt(interval**5 * np.diff(times))[:, None]
        jerk = coo_array(weight * unit.derivative(DEGREE)((times[1:] + times[:-1]) / 2))
        gram = coo_array(self._basis.T @ self._basis)
        self._bands = np.zeros((2 * WIDTH + 1, 2 * len(times) + 3))
        self._bands[WIDTH, [1, -2]] = 1
        for rows, columns, entries in ((2 * gram.row, 2 * gram.col, gram.data),
                                       (2 * jerk.row + 3, 2 * jerk.col, jerk.data),
                                       (2 * jerk.col, 2 * jerk.row + 3, jerk.data)):
            self._bands[WIDTH + rows - columns, columns] = entries

    def spline(self, smoothing: float, values: np.ndarray | None = None, jerks: np.ndarray | float = 0.0) -> BSpline:
        """Return the splines with mu = `smoothing` that approximate `values` (n, columns), by default the positions.
        Their J c approximates `jerks` (n - 1, columns)."""
        values = self._values if values is None else values
        # A line is a spline without jerk. Without the line between both ends, round-off is that of what is left.
        # Coefficients of a line are its values at the means of DEGREE successive knots.
        places = np.lib.stride_tricks.sliding_window_view(self._knots[1:-1], DEGREE).mean(1)
        along, rise = (np.append(self.times, places) - self.times[0]) / np.ptp(self.times), values[-1] - values[0]
        line = values[0] + np.outer(along, rise)
        self._bands[WIDTH, 3:-3:2] = -1 / smoothing
        right = np.zeros((self._bands.shape[1], values.shape[1]))
        right[::2] = self._basis.T @ (values - line[:len(values)])
        right[3:-3:2] = jerks
        solution = solve_banded((WIDTH, WIDTH), self._bands, right)[::2]
        return BSpline(self._knots, solution + line[len(values):], DEGREE)

    def residual(self, smoothing: float) -> np.ndarray:
        """Return three sums over the values: of the squared residuals, of the squares that errors of variance 1 leave
        on average, and the degrees of freedom.

        With the matrix R that maps values to residuals, the last two are the traces of R^T R and of R for each track
        and axis.
        """
        left, freedom, unit = 0.0, 0.0, np.eye(len(self.times))
        for first in range(0, len(unit), BLOCK):
            columns = unit[:, first:first + BLOCK]
            residuals = columns - self.spline(smoothing, columns)(self.times)
            left, freedom = left + np.sum(residuals**2), freedom + np.sum(residuals * columns)
        squares = np.sum((self.spline(smoothing)(self.times) - self._values) ** 2)
        return np.array([squares, 3 * self.tracks * left, 3 * self.tracks * freedom])

    def velocity_errors(self, smoothing: float, times: np.ndarray) -> np.ndarray:
        """Return `SmoothedTracks.velocity_errors` at `times` (m,) of a track. For tracks of more than RANDOM rows they
        are means over RANDOM sets of random data."""
        count, draw = len(self.times), np.random.default_rng(1)
        found = []
        for size in (count, count - 1):
            data = np.eye(size) if size <= RANDOM else draw.choice([-1.0, 1.0], (size, RANDOM)) / np.sqrt(RANDOM)
            spline = self.spline(smoothing, data) if size == count else self.spline(
                smoothing, np.zeros((count, data.shape[1])), data / np.sqrt(smoothing))
            found.append((spline.derivative()(times) ** 2).sum(1))
        return np.stack(found, 1)

    def derivatives(self, smoothing: float, times: np.ndarray) -> Iterator[np.ndarray]:
        """Yield positions, then velocities, of the splines at `times` (m,), each (tracks * m, 3), track after track."""
        spline = self.spline(smoothing)
        for values in (spline(times), spline.derivative()(times)):
            yield np.moveaxis(values.reshape(len(times), self.tracks, 3), 1, 0).reshape(-1, 3)


def _smoothing_of(fits: list[Fit], noise: float | None) -> tuple[float, float]:
    """Return the mu that fits the noise of the longest tracks, and the noise that their residuals show with this mu.
    Without a given noise, return the mu of generalised cross-validation, and the noise that it estimates.

    If the noise is too large for any mu, the splines are parabolas. mu is at least the power of ten that minimises the
    error of generalised cross-validation, which needs no noise. Otherwise a noise that is given 2 % too small would
    leave nearly all of the noise in the velocities.
    """
    longest = sorted(fits, key=lambda fit: -len(fit.times))
    chosen = longest[:np.searchsorted(np.cumsum([fit.tracks for fit in longest]), TRIED) + 1]

    rows = len(longest[0].times)
    if rows <= LEAST_ROWS:
        return NO_NOISE, np.nan

    def sums(logarithm: float) -> np.ndarray:
        return np.sum([fit.residual(10.0**logarithm) for fit in chosen], axis=0)

    def shown(logarithm: float) -> float:
        squares, left, _ = sums(logarithm)
        return float(np.sqrt(squares / left))

    tried = np.arange(np.log10(NO_NOISE), np.log10(PARABOLA * rows**6) + 1)
    squares, left, freedom = np.transpose([sums(logarithm) for logarithm in tried])
    crossed = np.argmin(squares / freedom**2)
    best = tried[crossed]
    if noise is None:
        return float(10.0**best), float(np.sqrt(squares[crossed] / freedom[crossed]))
    fitting = np.flatnonzero(squares <= left * noise**2)
    if len(fitting):
        last = fitting[-1]
        best = max(best, tried[-1] if last == len(tried) - 1 else brentq(
            lambda logarithm: shown(logarithm) - noise, tried[last], tried[last + 1], xtol=0.01))
    return float(10.0**best), shown(best)


def _unwrapped(positions: np.ndarray, edge: float | None) -> np.ndarray:
    """Return positions (tracks, n, 3) in a periodic cube as continuous tracks; unchanged if `edge` is None."""
    if edge is None:
        return positions
    moved = np.diff(positions, axis=1)
    return positions - edge * np.cumsum(np.rint(np.pad(moved, ((0, 0), (1, 0), (0, 0))) / edge), axis=1)
