"""Lagrangian statistics of particles over a few frames: what they remember, how they are accelerated and spread.

Of model and truth they are measured over the same frames, of the same particles.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eddies.analysis.against_truth import CommonFrames, ParticleFrames
from eddies.analysis.errors import rms_log_ratio
from eddies.analysis.lagrangian import correlation, increment_flatness, nearest_rows, separations, structure_function

VALUES = 2**22  # of a column of vectors that are held at once, over all frames
LAGS = 18       # at most
TETRADS = 1000  # particles around which pairs and tetrads are followed
CORNERS = 4


@dataclass(frozen=True)
class PathStatistics:
    """What particles do over frames at equal intervals.

    Parameters
    ----------
    times : of the frames, (m,).
    lags : times, (l,). structure, flatness : of the increments of a velocity component over a lag, <dv^2> and
        <dv^4>/<dv^2>^2, of a normal distribution 3; (l,).
    velocity_correlation : with the first frame, (m,).
    acceleration_correlation : over the lags, (l,). acceleration_variance : of a component, (m,).
    pair_dispersion : <|r(t) - r(0)|^2> of nearest neighbours in units of <r(0)^2>, (m,).
    tetrad_size : <R^2> of a particle and its three nearest neighbours over that at the start, R^2 = sum |x_i - x|^2,
        x their mean; (m,).
    tetrad_shape : mean eigenvalues of sum (x_i - x)(x_i - x)^T over R^2, the largest first, 1/3 each of a regular
        tetrahedron (Chertkov, Pumir & Shraiman 1999); (m, 3).
    """

    times: np.ndarray
    lags: np.ndarray
    structure: np.ndarray
    flatness: np.ndarray
    velocity_correlation: np.ndarray
    acceleration_correlation: np.ndarray
    acceleration_variance: np.ndarray
    pair_dispersion: np.ndarray
    tetrad_size: np.ndarray
    tetrad_shape: np.ndarray


def of_both(model: ParticleFrames, truth: ParticleFrames, common: CommonFrames,
            length: float) -> tuple[PathStatistics, PathStatistics]:
    """Statistics of model and truth over all common frames, of the same particles, near each other at the first."""
    tetrads = near_tetrads(truth.read(int(common.truth[0]), "position"), length)
    return (path_statistics(model, common.model, tetrads, length),
            path_statistics(truth, common.truth, tetrads, length))


def near_tetrads(position: np.ndarray, length: float) -> np.ndarray:
    """Rows (4, m) of particles (n, 3) and of the nearest three others of each, of at most `TETRADS` chosen evenly."""
    chosen = np.unique(np.linspace(0, len(position) - 1, min(len(position), TETRADS)).astype(int))
    return np.concatenate([chosen[None], nearest_rows(position, length, chosen, CORNERS - 1)])


def path_statistics(run: ParticleFrames, chosen: Sequence[int], tetrads: np.ndarray, length: float) -> PathStatistics:
    """Measure the chosen frames of a run, whose tetrads are rows (4, g) of its particles."""
    chosen = [int(frame) for frame in chosen]
    times = run.times[chosen] - run.times[chosen[0]]
    velocity, acceleration = (_sample(run, chosen, column) for column in ("velocity", "acceleration"))
    longest = len(chosen) - 1
    steps = np.unique(np.rint(np.geomspace(1, longest, LAGS)).astype(int)) if longest else np.empty(0, int)
    return PathStatistics(
        times, times[steps], structure_function(velocity, steps), increment_flatness(velocity, steps),
        np.array([correlation(velocity[0], later) for later in velocity]),
        np.array([np.mean([correlation(earlier, later) for earlier, later in zip(acceleration, acceleration[step:])])
                  for step in steps]),
        np.array([np.var(values, dtype=float) for values in acceleration]),
        *_spreading(run, chosen, tetrads, length))


def differences(model: PathStatistics, truth: PathStatistics) -> dict[str, float]:
    """A number for each of these measures, model against truth: the rms of the logarithm of their ratio over lags, or
    over times after the first, when both are the same particles; of correlations, which change sign, of their
    difference."""
    def log_ratio(name: str, first: int = 0) -> float:
        return rms_log_ratio(getattr(model, name)[first:], getattr(truth, name)[first:])

    apart = model.acceleration_correlation - truth.acceleration_correlation
    return {
        "structure_error": log_ratio("structure"),
        "flatness_error": log_ratio("flatness"),
        "acceleration_correlation_error": float(np.sqrt(np.mean(apart**2))) if apart.size else np.nan,
        "acceleration_variance_error": log_ratio("acceleration_variance"),
        "pair_dispersion_error": log_ratio("pair_dispersion", 1),
        "tetrad_size_error": log_ratio("tetrad_size", 1),
        "tetrad_shape_error": log_ratio("tetrad_shape", 1),
    }


def _sample(run: ParticleFrames, chosen: Sequence[int], column: str) -> np.ndarray:
    """A column of vectors (m, n, 3) of evenly chosen particles."""
    first = run.read(chosen[0], column)
    every = -(-first.size * len(chosen) // VALUES)
    return np.stack([run.read(frame, column)[::every] for frame in chosen])


def _spreading(run: ParticleFrames, chosen: Sequence[int], tetrads: np.ndarray,
               length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Dispersion of the pairs of the first two corners, size and shape of the tetrads, over the frames."""
    first = np.tile(tetrads[0], CORNERS - 1)
    paths = separations((run.read(frame, "position") for frame in chosen), tetrads[1:].ravel(), first, length)
    pairs, sizes, shapes, start = [], [], [], None
    for separation in paths:
        corners = np.concatenate([np.zeros((1, tetrads.shape[1], 3)), separation.reshape(CORNERS - 1, -1, 3)])
        start = corners[1] if start is None else start
        pairs.append(np.sum((corners[1] - start) ** 2) / np.sum(start**2))
        size, shape = tetrad_moments(corners)
        sizes.append(size.mean())
        shapes.append(shape.mean(axis=0))
    return np.array(pairs), np.array(sizes) / sizes[0], np.array(shapes)


def tetrad_moments(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """R^2 (g,) and the eigenvalues of the moments over R^2 (g, 3), the largest first, of tetrads (4, g, 3)."""
    offsets = corners - corners.mean(axis=0)
    eigenvalues = np.linalg.eigvalsh(np.einsum("cgi,cgj->gij", offsets, offsets))[:, ::-1]
    size = eigenvalues.sum(axis=1)
    return size, eigenvalues / size[:, None]
