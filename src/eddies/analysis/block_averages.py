"""Averages of a stationary flow over blocks of time, and how far they can be trusted.

Successive frames are no independent samples: the large eddies, which hold the energy, change in about a turnover, the
correlation time of a flow. Blocks of at least a turnover each are nearly independent of each other, so that the scatter
of their means tells the error of the mean. Where energies swing over several turnovers, as forced ones do, even these
errors are too small.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Estimate:
    """A number with its standard error, which is not a number where there are too few blocks."""

    value: float
    error: float

    @property
    def known_error(self) -> float | None:
        """The error where it is known."""
        return self.error if np.isfinite(self.error) else None


@dataclass(frozen=True)
class Blocks:
    """Equal spans of time, as many as are no shorter than asked for.

    Parameters
    ----------
    times : of the samples, (n,). members : the samples of each block.
    """

    times: np.ndarray
    members: Sequence[np.ndarray]

    @classmethod
    def of(cls, times: np.ndarray, shortest: float) -> "Blocks":
        """Blocks of samples at rising times; one where all of it is shorter than two, and none that is empty."""
        span = float(times[-1] - times[0])
        count = max(min(int(span / shortest + 1e-9), len(times)), 1)
        block = ((times - times[0]) * (count / max(span, 1e-300)) + 1e-9).astype(int).clip(max=count - 1)
        members = [np.flatnonzero(block == number) for number in range(count)]
        return cls(times, [rows for rows in members if rows.size])

    def means(self, samples: np.ndarray) -> np.ndarray:
        """Mean of each block: (n, ...) -> (blocks, ...)."""
        return np.array([samples[rows].mean(axis=0) for rows in self.members])

    def mean(self, samples: np.ndarray) -> Estimate:
        """Mean over the blocks of samples (n,), and its standard error, that of one block over the root of their
        number."""
        return self.of_mean(samples, float)

    def of_mean(self, samples: np.ndarray, function: Callable[[np.ndarray], float]) -> Estimate:
        """A function of the mean of samples (n, ...), with its standard error by leaving each block out once (the
        jackknife, Miller 1974), which for the mean itself is the usual one."""
        means = self.means(samples)
        count, value = len(means), function(means.mean(axis=0))
        if count < 2:
            return Estimate(value, np.nan)
        without = np.array([function((means.sum(axis=0) - mean) / (count - 1)) for mean in means])
        return Estimate(value, float(np.sqrt((count - 1) * np.var(without))))

    def trend(self, samples: np.ndarray) -> Estimate:
        """Slope of the straight line through samples (n,), and its standard error from the scatter of the blocks' means
        around it, which takes three blocks."""
        offsets, deviations = self.times - self.times.mean(), samples - samples.mean()
        slope = float(np.sum(offsets * deviations) / np.sum(offsets**2)) if offsets.any() else np.nan
        times, left = self.means(offsets), self.means(deviations - slope * offsets)
        if len(times) < 3:
            return Estimate(slope, np.nan)
        spread = np.sum((times - times.mean()) ** 2)
        return Estimate(slope, float(np.sqrt(np.sum((left - left.mean()) ** 2) / (len(times) - 2) / spread)))
