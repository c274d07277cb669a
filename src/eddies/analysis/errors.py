"""Errors of predictions and of energy spectra against a known truth."""

import numpy as np


def normalized_l2(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Return the normalised L2 error |prediction - truth| / |truth| over all entries of two arrays of the same shape.

    The result is NaN if the truth is zero. Raises ValueError if the shapes differ.
    """
    return _relative(prediction, truth, np.asarray(truth, dtype=float))


def velocity_error(prediction: np.ndarray, truth: np.ndarray) -> float:
    """Return |prediction - truth| / |fluctuations(truth)| of velocities (n, 3) of the same particles.

    A mean velocity depends on the frame of reference, so it is no part of the norm. The result is NaN if the truth has
    no fluctuation. Raises ValueError if the shapes differ.
    """
    return _relative(prediction, truth, fluctuations(truth))


def fluctuations(rows: np.ndarray) -> np.ndarray:
    """Return rows (n, ...) minus their mean row, in double precision.

    The result is zero if no fluctuation is above the round-off error of the mean.
    """
    rows = np.asarray(rows)
    mean = rows.mean(axis=0, dtype=float)
    found, least = rows - mean, 100 * np.finfo(rows.dtype).eps * np.abs(mean).max(initial=0.0)
    return found if np.abs(found).max(initial=0.0) > least else np.zeros_like(found)


def _relative(prediction: np.ndarray, truth: np.ndarray, norm: np.ndarray) -> float:
    if np.shape(prediction) != np.shape(truth):
        raise ValueError(f"prediction has shape {np.shape(prediction)}, truth {np.shape(truth)}: they must be equal")
    error, size = np.linalg.norm(np.asarray(prediction, dtype=float) - truth), np.linalg.norm(norm)
    return float(error / size) if size > 0 else np.nan


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


def spectrum_error(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> float:
    """Return the root mean square of ln(E(k) / E_reference(k)) over the shells 1 <= k <= largest_wavenumber.

    `energy` and `reference` are (shells,), from k = 0 on. The shell k = 1 always counts. If the last shell has
    k < largest_wavenumber, the mean ends there. The result is not finite if one of these shells has no energy in
    `energy` or in `reference`.
    """
    shells = slice(1, _last_shell(largest_wavenumber, energy) + 1)
    return rms_log_ratio(energy[shells], reference[shells])


def band_ratios(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> dict[str, float]:
    """Return, for each of the bands of shells "1-2", "3-4", "5-8", ..., its energy divided by that in `reference`.

    All bands together have the shells of `spectrum_error`, so the last band may be narrower.
    """
    last, ratios, first, end = _last_shell(largest_wavenumber, energy), {}, 1, 2
    while first <= last:
        end = min(end, last)
        band = slice(first, end + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios[f"{first}-{end}" if end > first else f"{first}"] = float(energy[band].sum() / reference[band].sum())
        first, end = end + 1, 2 * end
    return ratios


def _last_shell(largest_wavenumber: float, energy: np.ndarray) -> int:
    return min(max(int(largest_wavenumber + 1e-9), 1), len(energy) - 1)
