"""Histogram PDFs that keep their mass, and the divergence between two of them."""

from collections.abc import Callable

import numpy as np

FLOOR = 1e-6  # added to every bin's probability before a divergence: an empty bin must not make it infinite


def bin_edges(half_width: float, bins: int) -> np.ndarray:
    """Edges (bins + 1,) of equal bins over [-half_width, half_width]."""
    return np.linspace(-half_width, half_width, bins + 1)


def bin_probabilities(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Fraction of all values in each bin (bins,), summing to 1: values beyond the ends count in the end bins.

    `values` may have any shape; only their number matters. Raises ValueError if there is none or one is not
    finite.
    """
    values = np.asarray(values, dtype=float).ravel()
    if values.size == 0 or not np.isfinite(values).all():
        raise ValueError("a PDF needs at least one value, and finite ones only")
    counts, _ = np.histogram(np.clip(values, edges[0], edges[-1]), edges)
    return counts / values.size


def pdf(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Probability density (bins,) on the bins: its integral over them is exactly 1."""
    return bin_probabilities(values, edges) / np.diff(edges)


def joint_probabilities(
    first: np.ndarray, second: np.ndarray, first_edges: np.ndarray, second_edges: np.ndarray
) -> np.ndarray:
    """Fraction of the value pairs in each cell, (first bins, second bins), outliers in the outer cells."""
    first = np.clip(np.ravel(first), first_edges[0], first_edges[-1])
    second = np.clip(np.ravel(second), second_edges[0], second_edges[-1])
    counts, _, _ = np.histogram2d(first, second, (first_edges, second_edges))
    return counts / first.size


def kl_divergence(truth: np.ndarray, prediction: np.ndarray, floor: float = FLOOR) -> float:
    """Forward Kullback-Leibler divergence sum p ln(p / q) of the truth p from the prediction q, in nats (P:
    Eq. 14).

    Both are bin probabilities on the same bins, of one shape. `floor` is added to every bin of both, which
    are then normalised again. Zero if and only if they are equal.
    """
    if truth.shape != prediction.shape:
        raise ValueError(f"the bins differ: {truth.shape} and {prediction.shape}")
    p = (truth + floor) / (truth + floor).sum()
    q = (prediction + floor) / (prediction + floor).sum()
    return float(np.sum(p * np.log(p / q)))


def sampling_divergence(rows: int, probabilities: Callable[[np.ndarray], np.ndarray]) -> float:
    """The divergence to expect of two samples of one distribution, each of so many `rows`: what a perfect model is
    found to have whose particles are others than those of the truth.

    Half of what two halves, drawn from a fixed seed, have: it falls as one over the number of rows. `probabilities` of
    the bins are those of the rows that it is given.
    """
    shuffled = np.random.default_rng(0).permutation(rows)
    return kl_divergence(*(probabilities(half) for half in np.array_split(shuffled, 2))) / 2


def standardized(values: np.ndarray, reference: np.ndarray | None = None) -> np.ndarray:
    """(values - mean) / standard deviation, both taken from `reference` (default: the values themselves)."""
    reference = values if reference is None else reference
    deviation = np.std(reference)
    if deviation == 0:
        raise ValueError("constant values have no standardised PDF")
    return (values - np.mean(reference)) / deviation


def gaussian(values: np.ndarray) -> np.ndarray:
    """Density of the standard normal distribution."""
    return np.exp(-(values**2) / 2) / np.sqrt(2 * np.pi)
