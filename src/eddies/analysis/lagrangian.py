"""Lagrangian statistics of particles: increments and correlations of velocity, accelerations, and dispersion.

Model and truth are measured over the same frames, with the same particles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from eddies.analysis.errors import fluctuations, rms_log_ratio
from eddies.analysis.rollout import Frames, Rollout
from eddies.parallel.migration import wrap

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

VALUES = 2**22  # about the largest number of values of a column in memory at once, all frames together
LAGS = 18       # largest number of lags
TETRADS = 1000  # largest number of tetrads that are followed
CORNERS = 4     # particles of a tetrad


@dataclass(frozen=True)
class PathStatistics:
    """Statistics of particle paths over m frames at equal intervals.

    Parameters
    ----------
    times, lags : times of the frames since the first, (m,), and lags in units of time, (l,).
    structure, flatness : <dv^2> and <dv^4>/<dv^2>^2 of the increments dv of a velocity component over a lag, (l,).
    velocity_correlation : correlation of the velocities in each frame with those in the first frame, (m,).
    acceleration_correlation : correlation of the accelerations in two frames that are a lag apart, (l,).
    acceleration_variance : variance of an acceleration component, (m,).
    pair_dispersion : <|r(t) - r(0)|^2> / <r(0)^2> of the separation r of nearest neighbours, (m,).
    tetrad_size : <R^2> divided by its value at the start, (m,). A tetrad is a particle and its three nearest
        neighbours, and R^2 is the sum of |x_i - x|^2 with the mean x of the four positions.
    tetrad_shape : mean eigenvalues of sum (x_i - x)(x_i - x)^T divided by R^2, the largest first, (m, 3); each is 1/3
        for a regular tetrahedron (Chertkov, Pumir & Shraiman 1999).
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


def of_both(run: Rollout) -> tuple[PathStatistics, PathStatistics]:
    """Return the statistics of model and truth over all common frames.

    Tetrads are chosen from the true positions in the first common frame. Model and truth use the same particles.
    """
    tetrads = near_tetrads(run.pair(0, "position").truth, run.length)
    return path_statistics(run.model, run.common.model, tetrads), path_statistics(run.truth, run.common.truth, tetrads)


def evenly(total: int, most: int) -> np.ndarray:
    """Return row numbers from 0 to total - 1: all of them or, if there are more than `most`, `most` evenly spread."""
    return np.unique(np.linspace(0, total - 1, min(total, most)).astype(int))


def lags_of(longest: int) -> np.ndarray:
    """Return lags counted in frames: at most LAGS integers from 1 to `longest`, about evenly spread in the logarithm.

    There are none if `longest` is 0.
    """
    return np.unique(np.rint(np.geomspace(1, longest, LAGS)).astype(int)) if longest else np.empty(0, int)


def search_tree(position: np.ndarray, length: float) -> cKDTree:
    """Return a tree that finds neighbours among positions (n, 3) in a periodic box of edge `length`.

    The attribute `data` of the tree holds the positions, wrapped into the box.
    """
    from scipy.spatial import cKDTree  # here, because the import is slow and other functions do not need it
    # A tree that is neither balanced nor compact is built several times faster.
    return cKDTree(wrap(position.astype(float), length), boxsize=length, balanced_tree=False, compact_nodes=False)


def near_tetrads(position: np.ndarray, length: float) -> np.ndarray:
    """Return the row numbers (4, m) of the particles of m tetrads; m is at most TETRADS.

    A tetrad is a particle, which comes first, and its three nearest neighbours. `position` (n, 3) is in a periodic box
    of edge `length`. Raises ValueError for fewer than four particles.
    """
    if len(position) < CORNERS:
        raise ValueError(f"{len(position)} particles: at least {CORNERS} are needed")
    tree = search_tree(position, length)
    return tree.query(tree.data[evenly(len(position), TETRADS)], CORNERS)[1].T


def path_statistics(run: Frames, chosen: Sequence[int], tetrads: np.ndarray) -> PathStatistics:
    """Return statistics of a run in the `chosen` frames. `tetrads` (4, g) holds the row numbers of the particles of g
    tetrads."""
    chosen = [int(frame) for frame in chosen]
    times = run.times[chosen] - run.times[chosen[0]]
    velocity, acceleration = (_sample(run, chosen, column) for column in ("velocity", "acceleration"))
    lags = lags_of(len(chosen) - 1)
    return PathStatistics(
        times, times[lags], structure_function(velocity, lags), increment_flatness(velocity, lags),
        np.array([correlation(velocity[0], later) for later in velocity]),
        _over_lags(acceleration, lags, correlation),
        np.array([np.var(values, dtype=float) for values in acceleration]),
        *_dispersion(run, chosen, tetrads))


def differences(model: PathStatistics, truth: PathStatistics) -> dict[str, float]:
    """Return errors of the model by name.

    An error is the rms of ln(model / truth) over lags or times. Errors of the dispersion and of tetrads leave out the
    first time, when model and truth are equal. The correlation of accelerations changes sign; therefore its error is
    the rms of the difference.
    """
    def log_ratio(name: str, first: int = 0) -> float:
        return rms_log_ratio(getattr(model, name)[first:], getattr(truth, name)[first:])

    difference = model.acceleration_correlation - truth.acceleration_correlation
    return {
        "structure_error": log_ratio("structure"),
        "flatness_error": log_ratio("flatness"),
        "acceleration_correlation_error": float(np.sqrt(np.mean(difference**2))) if difference.size else np.nan,
        "acceleration_variance_error": log_ratio("acceleration_variance"),
        "pair_dispersion_error": log_ratio("pair_dispersion", 1),
        "tetrad_size_error": log_ratio("tetrad_size", 1),
        "tetrad_shape_error": log_ratio("tetrad_shape", 1),
    }


def _sample(run: Frames, chosen: Sequence[int], column: str) -> np.ndarray:
    """Read a vector column of every k-th particle in the m `chosen` frames: (m, n, 3).

    k is the smallest integer for which the result has at most about VALUES numbers.
    """
    every = -(-run.read(chosen[0], column).size * len(chosen) // VALUES)
    return np.stack([run.read(frame, column)[::every] for frame in chosen])


def _dispersion(run: Frames, chosen: Sequence[int],
                tetrads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return pair dispersion (m,), tetrad size (m,) and tetrad shape (m, 3) in the m `chosen` frames.

    The pairs are the first two particles of each tetrad. `tetrads` (4, g) holds row numbers.
    """
    first = np.tile(tetrads[0], CORNERS - 1)
    paths = separations((run.read(frame, "position") for frame in chosen), tetrads[1:].ravel(), first, run.length)
    pairs, sizes, shapes, start = [], [], [], None
    for separation in paths:
        corners = np.concatenate([np.zeros((1, tetrads.shape[1], 3)), separation.reshape(CORNERS - 1, -1, 3)])
        start = corners[1] if start is None else start
        pairs.append(np.sum((corners[1] - start) ** 2))
        size, shape = tetrad_moments(corners)
        sizes.append(size.mean())
        shapes.append(shape[size > 0].mean(axis=0) if size.any() else np.full(3, np.nan))
    return _over(pairs, np.sum(start**2)), _over(sizes, sizes[0]), np.array(shapes)


def _over(values: Any, scale: Any) -> np.ndarray:
    """Divide; the result is NaN where `scale` is 0, as for particles at the same place."""
    return np.asarray(values) / np.where(scale > 0, scale, np.nan)


def tetrad_moments(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the size R^2 (g,) and the shape (g, 3) of g tetrads from the positions `corners` (4, g, 3).

    The shape consists of the eigenvalues of sum (x_i - x)(x_i - x)^T, divided by R^2, the largest first. x is the mean
    of the four positions x_i. It is NaN for particles at the same place.
    """
    offsets = corners - corners.mean(axis=0)
    eigenvalues = np.linalg.eigvalsh(np.einsum("cgi,cgj->gij", offsets, offsets))[:, ::-1]
    size = eigenvalues.sum(axis=1)
    return size, _over(eigenvalues, size[:, None])


def correlation(initial: np.ndarray, later: np.ndarray) -> float:
    """Return <v(0).v(t)> / sqrt(<v(0)^2> <v(t)^2>) of vectors (n, 3) of the same particles at two times.

    v is the vector minus its mean over the particles. The result is NaN if all v(0) or all v(t) are 0.
    """
    initial, later = fluctuations(initial), fluctuations(later)
    with np.errstate(invalid="ignore"):
        return float(np.sum(initial * later) / np.sqrt(np.sum(initial**2) * np.sum(later**2)))


def structure_function(velocity: Sequence[np.ndarray], lags: np.ndarray) -> np.ndarray:
    """Return the second-order Lagrangian structure function of a velocity component, <|v(t + lag) - v(t)|^2> / 3, (m,).

    `velocity` is (frames, n, 3) at equal intervals; `lags` (m,) count frames. The mean is over particles and over all
    frames t.
    """
    return _over_lags(velocity, lags, lambda earlier, later: np.mean(np.square(later - earlier, dtype=float)))


def increment_flatness(velocity: Sequence[np.ndarray], lags: np.ndarray) -> np.ndarray:
    """Return the flatness <dv^4> / <dv^2>^2 of the increments dv of a velocity component over each lag, (m,).

    It is 3 for Gaussian increments, and NaN for a constant velocity. Arguments are those of `structure_function`. The
    flatness is averaged over start frames, so that the decay of a flow does not widen the tails.
    """
    def flatness(earlier: np.ndarray, later: np.ndarray) -> float:
        square = np.square(later - earlier, dtype=float)
        return np.mean(square**2) / np.mean(square) ** 2

    with np.errstate(invalid="ignore"):
        return _over_lags(velocity, lags, flatness)


def _over_lags(values: Sequence[np.ndarray], lags: np.ndarray,
               function: Callable[[np.ndarray, np.ndarray], float]) -> np.ndarray:
    """Return, for each lag, the mean of `function` over all pairs of frames that are a lag apart.

    The arguments of `function` are the values in the earlier and in the later frame.
    """
    return np.array([np.mean([function(earlier, later) for earlier, later in zip(values, values[lag:])])
                     for lag in lags])


def minimum_image(displacement: np.ndarray, length: float) -> np.ndarray:
    """Return the displacements to the nearest periodic images; arrays have any shape."""
    return displacement - length * np.rint(displacement / length)


def separations(position: Iterable[np.ndarray], first: np.ndarray, second: np.ndarray,
                length: float) -> Iterator[np.ndarray]:
    """Yield for each frame the separations x_first - x_second (m, 3) of m pairs of particles.

    `position` yields the positions (n, 3) of each frame, which may be wrapped into the box. `first` and `second` (m,)
    are row numbers of particles. The first separation is to the nearest image. Later ones are continuous if no
    component of a separation changes by more than length / 2 between frames.
    """
    separation = 0.0
    for frame in position:
        wrapped = frame[first] - frame[second]
        separation = separation + minimum_image(wrapped - separation, length)
        yield separation


def pair_dispersion(position: Iterable[np.ndarray], groups: Sequence[np.ndarray], length: float) -> np.ndarray:
    """Return <|r(t) - r(0)|^2> of each group of pairs in each frame, (groups, frames); r is the separation of a pair.

    A group holds the row numbers (2, m) of its pairs. `position` yields the positions (n, 3) of each frame.
    """
    paths = separations(position, *np.concatenate(groups, axis=1), length)
    start, ends = next(paths), np.cumsum([pairs.shape[1] for pairs in groups])[:-1]
    spread = [[0.0] * len(groups)]
    for separation in paths:
        squared = np.sum((separation - start) ** 2, axis=1)
        spread.append([np.mean(group) for group in np.split(squared, ends)])
    return np.transpose(spread)


def pairs_at(position: np.ndarray, length: float, distances: Sequence[float], tolerance: float,
             followed: int) -> list[np.ndarray]:
    """Return, for each distance, the row numbers (2, m) of the pairs of particles at this distance.

    `tolerance` is the largest relative deviation from this distance. The first particle of a pair is in the first
    `followed` rows of `position` (n, 3). Each pair appears once.
    """
    centres, tree = search_tree(position[:followed], length), search_tree(position, length)
    reach = (1 + tolerance) * max(distances, default=0.0)
    found = centres.sparse_distance_matrix(tree, reach, output_type="ndarray")
    found = found[found["i"] < found["j"]]
    pairs, distance = np.stack([found["i"], found["j"]]), found["v"]
    at_distance = [pairs[:, np.abs(distance - wanted) <= tolerance * wanted] for wanted in distances]
    return [chosen[:, np.lexsort(chosen[::-1])] for chosen in at_distance]
