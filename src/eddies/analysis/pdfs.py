"""Histogram PDFs that count every value, and the divergence between two of them."""

from collections.abc import Callable

import numpy as np

FLOOR = 1e-6  # added to the probability of every bin, so that an empty bin does not make a divergence infinite


def bin_edges(half_width: float, bins: int) -> np.ndarray:
    """Return the edges (bins + 1,) of equal bins over [-half_width, half_width]."""
    return np.linspace(-half_width, half_width, bins + 1)


def bin_centres(edges: np.ndarray) -> np.ndarray:
    """Return the middle of each bin, (bins,)."""
    return (edges[1:] + edges[:-1]) / 2


def bin_probabilities(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the fraction of the values in each bin, (bins,). Values beyond the ends count in the end bins.

    The values have any shape. Raises ValueError if there are none, or if one is not finite.
    """
    values = np.asarray(values, dtype=float).ravel()
    if values.size == 0 or not np.isfinite(values).all():
        raise ValueError("a PDF needs at least one value, and all values must be finite")
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return counts / values.size


def pdf(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the probability density of the values in each bin, (bins,). Its integral over the bins is 1."""
    return bin_probabilities(values, edges) / np.diff(edges)


def kl_divergence(truth: np.ndarray, prediction: np.ndarray) -> float:
    """Return the forward Kullback-Leibler divergence sum p ln(p / q) (the paper's Eq. 14).

    p are the bin probabilities of the truth, and q those of the prediction. First FLOOR is added to every bin, and p
    and q are normalised again. Raises ValueError if their shapes differ.
    """
    if truth.shape != prediction.shape:
        raise ValueError(f"the bins differ: {truth.shape} and {prediction.shape}")
    p = (truth + FLOOR) / (truth + FLOOR).sum()
    q = (prediction + FLOOR) / (prediction + FLOOR).sum()
    return float(np.sum(p * np.log(p / q)))


def sampling_divergence(rows: int, probabilities: Callable[[np.ndarray], np.ndarray]) -> float:
    """Return the expected divergence between two independent samples of `rows` rows. A perfect model has this value.

    `probabilities` maps row numbers of the one known sample to the bin probabilities of these rows. The divergence
    decreases as 1 / rows. So the estimate is half the divergence between two random halves of the known sample.
    """
    shuffled = np.random.default_rng(0).permutation(rows)
    return kl_divergence(*(probabilities(half) for half in np.array_split(shuffled, 2))) / 2


def standardized(values: np.ndarray, reference: np.ndarray | None = None) -> np.ndarray:
    """Return (values - mean) / standard deviation, with the mean of each component (last axis) of `reference`, and one
    standard deviation about these means.

    `reference` is by default `values`. A constant vector that is added to both changes nothing. Raises ValueError if
    the rows of `reference` are equal.
    """
    reference = values if reference is None else reference
    mean = np.mean(reference, axis=0, dtype=float)
    deviation = np.std(reference - mean)
    if deviation == 0:
        raise ValueError("constant values have no standardised PDF")
    return (values - mean) / deviation


def gaussian(values: np.ndarray) -> np.ndarray:
    """Return the probability density of the standard normal distribution."""
    return np.exp(-(values**2) / 2) / np.sqrt(2 * np.pi)
