"""Error norms of predictions against a known truth."""

import numpy as np


def normalized_l2(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Return the normalised L2 error |prediction - truth| / |truth| over all entries of two arrays of the same shape.

    Raises ValueError if the shapes differ or the truth is zero.
    """
    prediction, truth = np.asarray(prediction, dtype=float), np.asarray(truth, dtype=float)
    if prediction.shape != truth.shape:
        raise ValueError(f"prediction has shape {prediction.shape}, truth {truth.shape}: they must be equal")
    norm = np.linalg.norm(truth.ravel())
    if norm == 0:
        raise ValueError("the truth is zero everywhere: a normalised error has no meaning")
    return float(np.linalg.norm((prediction - truth).ravel()) / norm)


def rms_log_ratio(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Return the root mean square of ln(prediction / truth) over all entries.

    If every prediction is wrong by a factor e^a or e^-a, a > 0, the result is a. The result is not finite if a ratio is
    not positive, and NaN if there are no entries.
    """
    prediction, truth = np.asarray(prediction, dtype=float), np.asarray(truth, dtype=float)
    if prediction.size == 0:
        return np.nan
    with np.errstate(divide="ignore", invalid="ignore"):
        return float(np.sqrt(np.mean(np.log(prediction / truth) ** 2)))
