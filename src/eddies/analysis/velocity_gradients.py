"""Invariants Q and R of the velocity gradient tensor, and the mean motion of particles in the Q-R plane.

The definitions are the paper's Eqs. 16 and 17.
"""

from dataclasses import dataclass

import numpy as np


def invariants(gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return Q = -1/2 Tr(A* A*) and R = -1/3 Tr(A* A* A*) of gradients A_ij = dv_i/dx_j: (..., 3, 3) -> (...).

    A* = A - 1/3 Tr(A) I is the part without trace.
    """
    trace = np.trace(gradient, axis1=-2, axis2=-1)
    traceless = gradient - trace[..., None, None] / 3 * np.eye(3)
    # The axes of components come first: sums over all particles at once take half the time of many small products.
    traceless = np.ascontiguousarray(np.moveaxis(traceless, (-2, -1), (0, 1)))
    squared = np.einsum("ik...,kj...->ij...", traceless, traceless)
    return -np.trace(squared) / 2, -np.einsum("ij...,ji...->...", squared, traceless) / 3


def enstrophy_scale(gradient: np.ndarray) -> float:
    """Return <Q_w> = <W_ij W_ij> / 2 with the antisymmetric part W of velocity gradients (n, 3, 3).

    <Q_w> is the unit of Q, and <Q_w>^(3/2) that of R.
    """
    rotation = (gradient - np.swapaxes(gradient, -1, -2)) / 2
    return float(np.mean(np.sum(rotation**2, axis=(-2, -1))) / 2)


@dataclass(frozen=True)
class Invariants:
    """Invariants of the velocity gradients at n particles at one time.

    `second` and `third` are Q and R (n,) in single precision, and `scale` is <Q_w>.
    """

    second: np.ndarray
    third: np.ndarray
    scale: float

    @classmethod
    def of(cls, gradient: np.ndarray) -> "Invariants":
        """Return the invariants of velocity gradients (n, 3, 3)."""
        second, third = invariants(gradient)
        return cls(second.astype(np.float32), third.astype(np.float32), enstrophy_scale(gradient))

    def normalized(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Return Q in units of `scale`, a value of <Q_w>, and R in units of scale^(3/2)."""
        return self.second.astype(float) / scale, self.third.astype(float) / scale**1.5


def vieillefosse_line(third_invariant: np.ndarray) -> np.ndarray:
    """Return Q on the Vieillefosse line, where the discriminant 27/4 R^2 + Q^3 is zero, for given R."""
    return -np.cbrt(27 / 4 * np.asarray(third_invariant) ** 2)


@dataclass(frozen=True)
class InvariantBins:
    """Bins of the Q-R plane for both model and truth.

    `second` holds the edges of Q / <Q_w>, and `third` those of R / <Q_w>^(3/2).
    """

    second: np.ndarray
    third: np.ndarray

    @classmethod
    def covering(cls, second: np.ndarray, third: np.ndarray, quantile: float = 0.999) -> "InvariantBins":
        """Return equal bins over |Q| < Q_m and |R| < R_m. Each of these two ranges holds the fraction `quantile` of the
        sample. The number of bins per axis is the cube root of the sample size, but at least 12 and at most 64."""
        bins = int(np.clip(round(second.size ** (1 / 3)), 12, 64))
        limits = [np.quantile(np.abs(values), quantile) for values in (second, third)]
        return cls(*(np.linspace(-limit, limit, bins + 1) for limit in limits))

    def probabilities(self, second: np.ndarray, third: np.ndarray) -> np.ndarray:
        """Return the probability of each cell, (Q bins, R bins). Values beyond the ends count in the outer cells."""
        clipped = [np.clip(values, edges[0], edges[-1])
                   for values, edges in ((second, self.second), (third, self.third))]
        return np.histogram2d(*clipped, (self.second, self.third))[0] / second.size

    def coarser(self) -> "InvariantBins":
        """Return bins over the same ranges, at most 18 per axis: conditional means need more particles per cell."""
        edges = min(18, self.second.size - 1) + 1
        return InvariantBins(*(np.linspace(fine[0], fine[-1], edges) for fine in (self.second, self.third)))

    def density(self, probabilities: np.ndarray) -> np.ndarray:
        """Return the joint PDF of Q and R from the probabilities of the cells."""
        return probabilities / np.outer(np.diff(self.second), np.diff(self.third))


class ConditionalVelocity:
    """Mean of (dQ/dt, dR/dt) over the particles in each cell of the Q-R plane.

    The units of the two rates are <Q_w>^(3/2) and <Q_w>^2. Particles outside the bins are left out.
    """

    def __init__(self, bins: InvariantBins) -> None:
        self.bins = bins
        self.count, self.second_rate, self.third_rate = np.zeros((3, bins.second.size - 1, bins.third.size - 1))

    def add(self, before: Invariants, after: Invariants, interval: float, scale: float) -> None:
        """Add the rates of particles between two times, `interval` apart; `scale` is <Q_w>.

        `before` and `after` are invariants of the same particles. The rate is their difference divided by the interval.
        It is assigned to the mean (Q, R) of both times, which is accurate to second order.
        """
        q0, r0, q1, r1 = (values.astype(float) for values in (before.second, before.third, after.second, after.third))
        middle = (q0 + q1) / 2 / scale, (r0 + r1) / 2 / scale**1.5
        edges = (self.bins.second, self.bins.third)
        rates = (q1 - q0) / interval / scale**1.5, (r1 - r0) / interval / scale**2
        self.count += np.histogram2d(*middle, edges)[0]
        self.second_rate += np.histogram2d(*middle, edges, weights=rates[0])[0]
        self.third_rate += np.histogram2d(*middle, edges, weights=rates[1])[0]

    def mean(self, at_least: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean (dQ/dt, dR/dt) of each cell. It is NaN in cells with fewer than `at_least` rates."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = self.second_rate / self.count, self.third_rate / self.count
        return tuple(np.where(self.count >= at_least, mean, np.nan) for mean in means)
