"""Averages of a stationary flow over blocks of time, and their standard errors.

Successive frames are not independent: the large eddies, which hold the energy, change in about a turnover. Means of
blocks of at least a turnover are nearly independent, so that their scatter gives the error of the mean. The energy of
a forced flow varies over several turnovers. Therefore these errors are still too small for a forced flow.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A number and its standard error. The error is NaN if there are too few blocks."""

    value: float
    error: float


@dataclass(frozen=True)
class Blocks:
    """Blocks of equal duration. `times` (n,) are the times of all samples. `members` holds, for each block, the row
    numbers of its samples."""

    times: np.ndarray
    members: Sequence[np.ndarray]

    @classmethod
    def of(cls, times: np.ndarray, shortest: float) -> "Blocks":
        """Divide the span of `times` into as many equal blocks as possible, each of duration `shortest` or more.

        A span shorter than `shortest` is one block. Blocks without samples are left out.
        """
        span = float(times[-1] - times[0])
        count = max(min(int(span / shortest + 1e-9), len(times)), 1)
        block = ((times - times[0]) * (count / max(span, 1e-300)) + 1e-9).astype(int).clip(max=count - 1)
        members = [np.flatnonzero(block == number) for number in range(count)]
        return cls(times, [rows for rows in members if rows.size])

    def means(self, samples: np.ndarray) -> np.ndarray:
        """Return the mean of the samples of each block: (n, ...) -> (blocks, ...)."""
        return np.array([samples[rows].mean(axis=0) for rows in self.members])

    def mean(self, samples: np.ndarray) -> Estimate:
        """Return the mean of the block means of samples (n,). Its error is the standard deviation of the block means
        divided by sqrt(blocks)."""
        return self.of_mean(samples, float)

    def of_mean(self, samples: np.ndarray, function: Callable[[np.ndarray], float]) -> Estimate:
        """Return the value of `function` at the mean of the block means of samples (n, ...).

        The error is the jackknife error over blocks (Miller 1974).
        """
        means = self.means(samples)
        count, value = len(means), function(means.mean(axis=0))
        if count < 2:
            return Estimate(value, np.nan)
        without = np.array([function((means.sum(axis=0) - mean) / (count - 1)) for mean in means])
        return Estimate(value, float(np.sqrt((count - 1) * np.var(without))))

    def trend(self, samples: np.ndarray) -> Estimate:
        """Return the slope of the regression line of samples (n,) over time.

        The error comes from the block means of the residuals. It is NaN for fewer than 3 blocks.
        """
        offsets, deviations = self.times - self.times.mean(), samples - samples.mean()
        slope = float(np.sum(offsets * deviations) / np.sum(offsets**2)) if offsets.any() else np.nan
        times, residuals = self.means(offsets), self.means(deviations - slope * offsets)
        if len(times) < 3:
            return Estimate(slope, np.nan)
        spread = np.sum((times - times.mean()) ** 2)
        variance = np.sum((residuals - residuals.mean()) ** 2) / (len(times) - 2)
        return Estimate(slope, float(np.sqrt(variance / spread)))
