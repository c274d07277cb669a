"""Velocities along measured tracks, by smoothing splines.

Each track is approximated by a cubic spline s(t) with a knot at each time t_i of the track. The spline minimises

    sum_i |x_i - s(t_i)|^2 + mu h^5 int |s'''|^2 dt,    h the median interval of all tracks.

x_i are the measured positions. This estimate assumes that their errors have equal variance, and that the jerk, the
third derivative of the true position, is white noise (TrackFit; Gesemann, Huhn, Schanz and Schröder 2016). The spline
damps angular frequencies above mu^(-1/6) / h. It needs no condition at the ends of a track.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline
from scipy.linalg import solveh_banded
from scipy.optimize import brentq
from scipy.sparse import csr_array, dia_array

DEGREE, LEAST_ROWS = 3, 3   # degree of a spline; fewest rows that determine a parabola, which has no jerk
NO_NOISE, MOST = 1e-6, 1e6  # smallest and largest mu; the smallest damps no frequency that the frames resolve
TRIED = 300                 # about the number of tracks from which mu is determined


@dataclass(frozen=True)
class SmoothedTracks:
    """Rows of tracks after smoothing.

    Parameters
    ----------
    rows : for each row, its row number in the arguments of `smooth`. Tracks with fewer than three rows are left out.
    position, velocity : (rows, 3). Positions are continuous along a track.
    smoothing : mu of the splines.
    """

    rows: np.ndarray
    position: np.ndarray
    velocity: np.ndarray
    smoothing: float


def smooth(time: np.ndarray, track: np.ndarray, position: np.ndarray, edge: float | None,
           noise: float = 0.0) -> SmoothedTracks:
    """Return tracks after smoothing by splines.

    Parameters
    ----------
    time, track : time of each row and number of its track, (rows,). Rows are in any order.
    position : (rows, 3), wrapped into the cube or not.
    edge : edge of a periodic cube, or None. Particles must move by less than half an edge between rows of a track.
    noise : standard deviation of the error of a measured coordinate. It determines mu: the sum of the squared
        residuals is then noise^2 times the number of degrees of freedom. If it is 0, mu is NO_NOISE.
    """
    order = np.lexsort((time, track))
    ends = np.flatnonzero(np.diff(track[order], append=track[order][-1] - 1)) + 1
    alike: dict[bytes, list[np.ndarray]] = defaultdict(list)
    for start, stop in zip([0, *ends[:-1]], ends):
        if stop - start >= LEAST_ROWS:
            rows = order[start:stop]
            alike[time[rows].tobytes()].append(rows)
    groups = [np.array(rows) for rows in alike.values()]
    if not groups:
        nothing = np.zeros((0, 3))
        return SmoothedTracks(np.zeros(0, int), nothing, nothing, NO_NOISE)
    interval = float(np.median(np.concatenate([np.diff(time[rows[0]]) for rows in groups])))
    fits = [Fit(time[rows[0]], _unwrapped(position[rows], edge), interval) for rows in groups]
    smoothing = _smoothing_of(fits, noise) if noise > 0 else NO_NOISE
    values = [np.concatenate(parts) for parts in zip(*(fit.derivatives(smoothing) for fit in fits))]
    return SmoothedTracks(np.concatenate([rows.ravel() for rows in groups]), *values, smoothing)


class Fit:
    """The splines of tracks with the same times (n,).

    `positions` is (tracks, n, 3). `interval` is h, the median interval of all tracks.
    """

    def __init__(self, times: np.ndarray, positions: np.ndarray, interval: float) -> None:
        self.times, self.tracks = times, len(positions)
        self._values = np.moveaxis(positions, 1, 0).reshape(len(times), -1)
        before, after = times[0] - times[1], times[-1] - times[-2]
        steps = np.arange(1, DEGREE + 1)
        self._knots = np.concatenate([times[0] + before * steps[::-1], times, times[-1] + after * steps])
        self._basis = BSpline.design_matrix(times, self._knots, DEGREE)
        unit = BSpline(self._knots, np.eye(len(times) + DEGREE - 1), DEGREE)
        jerk = csr_array(unit.derivative(DEGREE)((times[1:] + times[:-1]) / 2))
        self._penalty = interval**5 * jerk.T @ dia_array((np.diff(times)[None], [0]), shape=[len(times) - 1] * 2) @ jerk

    def spline(self, smoothing: float, values: np.ndarray | None = None) -> BSpline:
        """Return the splines with mu = `smoothing` that approximate `values` (n, columns), by default the positions."""
        matrix = self._basis.T @ self._basis + smoothing * self._penalty
        bands = np.zeros((DEGREE + 1, matrix.shape[0]))
        for offset in range(DEGREE + 1):
            bands[offset, :matrix.shape[0] - offset] = matrix.diagonal(-offset)
        right = self._basis.T @ (self._values if values is None else values)
        return BSpline(self._knots, solveh_banded(bands, right, lower=True), DEGREE)

    def residual(self, smoothing: float) -> tuple[float, float]:
        """Return the sum of squared residuals, and its number of degrees of freedom.

        This number is the number of values minus the trace of the matrix that maps values to smoothed values.
        """
        squares = float(np.sum((self.spline(smoothing)(self.times) - self._values) ** 2))
        influence = self.spline(smoothing, np.eye(len(self.times)))(self.times)
        return squares, 3 * self.tracks * (len(self.times) - float(np.trace(influence)))

    def derivatives(self, smoothing: float) -> Iterator[np.ndarray]:
        """Yield the smoothed positions, then the velocities, each (tracks * n, 3), track after track."""
        spline = self.spline(smoothing)
        for values in (spline(self.times), spline.derivative()(self.times)):
            yield np.moveaxis(values.reshape(len(self.times), self.tracks, 3), 1, 0).reshape(-1, 3)


def _smoothing_of(fits: list[Fit], noise: float) -> float:
    """Return the mu for which the residuals of the longest tracks have the variance noise^2.

    If no mu between NO_NOISE and MOST has this property, return the nearer of these two.
    """
    longest = sorted(fits, key=lambda fit: -len(fit.times))
    chosen = longest[:np.searchsorted(np.cumsum([fit.tracks for fit in longest]), TRIED) + 1]

    def excess(logarithm: float) -> float:
        squares, freedom = np.sum([fit.residual(10.0**logarithm) for fit in chosen], axis=0)
        return np.log(squares / freedom / noise**2 + 1e-300)

    low, high = np.log10(NO_NOISE), np.log10(MOST)
    if excess(low) >= 0:
        return NO_NOISE
    return MOST if excess(high) <= 0 else float(10 ** brentq(excess, low, high, xtol=0.01))


def _unwrapped(positions: np.ndarray, edge: float | None) -> np.ndarray:
    """Return positions (tracks, n, 3) in a periodic cube as continuous tracks; unchanged if `edge` is None."""
    if edge is None:
        return positions
    moved = np.diff(positions, axis=1)
    return positions - edge * np.cumsum(np.rint(np.pad(moved, ((0, 0), (1, 0), (0, 0))) / edge), axis=1)
