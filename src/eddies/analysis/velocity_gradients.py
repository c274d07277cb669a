"""Invariants of the velocity gradient tensor: the Q-R plane and the mean motion in it (Eqs. 16-17)."""

from dataclasses import dataclass

import numpy as np


def invariants(gradient: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Q = -1/2 Tr(A* A*) and R = -1/3 Tr(A* A* A*), A* = A - 1/3 Tr(A) I, A_ij = dv_i/dx_j: (..., 3, 3) -> (...)."""
    trace = np.trace(gradient, axis1=-2, axis2=-1)
    traceless = gradient - trace[..., None, None] / 3 * np.eye(3)
    # The axes of components come first: loops over particles take half the time of products of many small matrices.
    traceless = np.ascontiguousarray(np.moveaxis(traceless, (-2, -1), (0, 1)))
    squared = np.einsum("ik...,kj...->ij...", traceless, traceless)
    return -np.trace(squared) / 2, -np.einsum("ij...,ji...->...", squared, traceless) / 3


def enstrophy_scale(gradient: np.ndarray) -> float:
    """<Q_w> = <W_ij W_ij> / 2 with the antisymmetric part W. It is the unit of Q, and <Q_w>^(3/2) that of R."""
    rotation = (gradient - np.swapaxes(gradient, -1, -2)) / 2
    return float(np.mean(np.sum(rotation**2, axis=(-2, -1))) / 2)


@dataclass(frozen=True)
class Invariants:
    """Q and R (n,) of particles at one time, in single precision, and <Q_w>."""

    second: np.ndarray
    third: np.ndarray
    scale: float

    @classmethod
    def of(cls, gradient: np.ndarray) -> "Invariants":
        """Invariants of velocity gradients (n, 3, 3)."""
        second, third = invariants(gradient)
        return cls(second.astype(np.float32), third.astype(np.float32), enstrophy_scale(gradient))

    def normalized(self, scale: float) -> tuple[np.ndarray, np.ndarray]:
        """Q and R in units of <Q_w> = `scale`."""
        return self.second.astype(float) / scale, self.third.astype(float) / scale**1.5


def vieillefosse_line(third_invariant: np.ndarray) -> np.ndarray:
    """Q on the line of zero discriminant 27/4 R^2 + Q^3 = 0, for given R."""
    return -np.cbrt(27 / 4 * np.asarray(third_invariant) ** 2)


@dataclass(frozen=True)
class InvariantBins:
    """Bins of the Q-R plane, shared by model and truth: edges of Q / <Q_w> and of R / <Q_w>^(3/2)."""

    second: np.ndarray
    third: np.ndarray

    @classmethod
    def covering(cls, second: np.ndarray, third: np.ndarray, quantile: float = 0.999) -> "InvariantBins":
        """Equal bins over |Q| < Q_m and |R| < R_m. Each range holds the fraction `quantile` of the sample.

        The number of bins per axis is the cube root of the sample size, but between 12 and 64.
        """
        bins = int(np.clip(round(second.size ** (1 / 3)), 12, 64))
        limits = [np.quantile(np.abs(values), quantile) for values in (second, third)]
        return cls(*(np.linspace(-limit, limit, bins + 1) for limit in limits))

    def probabilities(self, second: np.ndarray, third: np.ndarray) -> np.ndarray:
        """Probability of each cell (Q bins, R bins); outliers count in the outer cells."""
        clipped = [np.clip(values, edges[0], edges[-1])
                   for values, edges in ((second, self.second), (third, self.third))]
        return np.histogram2d(*clipped, (self.second, self.third))[0] / second.size

    def coarser(self) -> "InvariantBins":
        """The same ranges in at most 18 bins per axis, because conditional means need more particles per cell."""
        edges = min(18, self.second.size - 1) + 1
        return InvariantBins(*(np.linspace(fine[0], fine[-1], edges) for fine in (self.second, self.third)))

    def density(self, probabilities: np.ndarray) -> np.ndarray:
        """Joint PDF from cell probabilities."""
        return probabilities / np.outer(np.diff(self.second), np.diff(self.third))


class ConditionalVelocity:
    """Conditional mean of (dQ/dt, dR/dt) of Lagrangian particles given (Q, R), from sums in bins.

    The units of the two rates are <Q_w>^(3/2) and <Q_w>^2. Particles outside the bins are left out.
    """

    def __init__(self, bins: InvariantBins) -> None:
        self.bins = bins
        self.count, self.second_rate, self.third_rate = np.zeros((3, bins.second.size - 1, bins.third.size - 1))

    def add(self, before: Invariants, after: Invariants, interval: float, scale: float) -> None:
        """Add the same particles at two times, `interval` apart; `scale` is <Q_w>.

        The rate is the difference divided by the interval. It is assigned to the mean (Q, R) of both times, which is
        accurate to second order.
        """
        q0, r0, q1, r1 = (values.astype(float) for values in (before.second, before.third, after.second, after.third))
        middle = (q0 + q1) / 2 / scale, (r0 + r1) / 2 / scale**1.5
        edges = (self.bins.second, self.bins.third)
        rates = (q1 - q0) / interval / scale**1.5, (r1 - r0) / interval / scale**2
        self.count += np.histogram2d(*middle, edges)[0]
        self.second_rate += np.histogram2d(*middle, edges, weights=rates[0])[0]
        self.third_rate += np.histogram2d(*middle, edges, weights=rates[1])[0]

    def mean(self, at_least: int) -> tuple[np.ndarray, np.ndarray]:
        """Mean (dQ/dt, dR/dt) of each cell, NaN in cells that fewer than `at_least` particles passed."""
        with np.errstate(invalid="ignore", divide="ignore"):
            means = self.second_rate / self.count, self.third_rate / self.count
        return tuple(np.where(self.count >= at_least, mean, np.nan) for mean in means)
