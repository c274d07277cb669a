"""Lagrangian statistics of particles: what they remember, how they are accelerated and spread.

Of model and truth they are measured over the same frames, of the same particles.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from eddies.analysis.errors import rms_log_ratio
from eddies.analysis.rollout import CommonFrames, Frames

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


def of_both(model: Frames, truth: Frames, common: CommonFrames,
            length: float) -> tuple[PathStatistics, PathStatistics]:
    """Statistics of model and truth over all common frames, of the same particles, near each other at the first."""
    tetrads = near_tetrads(truth.read(int(common.truth[0]), "position"), length)
    return (path_statistics(model, common.model, tetrads, length),
            path_statistics(truth, common.truth, tetrads, length))


def near_tetrads(position: np.ndarray, length: float) -> np.ndarray:
    """Rows (4, m) of particles (n, 3) and of the nearest three others of each, of at most `TETRADS` chosen evenly."""
    chosen = np.unique(np.linspace(0, len(position) - 1, min(len(position), TETRADS)).astype(int))
    return np.concatenate([chosen[None], nearest_rows(position, length, chosen, CORNERS - 1)])


def path_statistics(run: Frames, chosen: Sequence[int], tetrads: np.ndarray, length: float) -> PathStatistics:
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


def _sample(run: Frames, chosen: Sequence[int], column: str) -> np.ndarray:
    """A column of vectors (m, n, 3) of evenly chosen particles."""
    first = run.read(chosen[0], column)
    every = -(-first.size * len(chosen) // VALUES)
    return np.stack([run.read(frame, column)[::every] for frame in chosen])


def _spreading(run: Frames, chosen: Sequence[int], tetrads: np.ndarray,
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


# ---- of arrays


def correlation(initial: np.ndarray, later: np.ndarray) -> float:
    """Lagrangian correlation <v(0).v(t)> / sqrt(<v(0)^2> <v(t)^2>): both (n, 3), by particle; not a number at rest."""
    with np.errstate(invalid="ignore"):
        return float(np.sum(initial * later) / np.sqrt(np.sum(initial**2) * np.sum(later**2)))


def structure_function(velocity: Sequence[np.ndarray], lags: np.ndarray) -> np.ndarray:
    """Second-order Lagrangian structure function <|v(t + lag) - v(t)|^2> / 3 per component.

    velocity (frames, n, 3) at equal intervals, lags (m,) in frames; mean over particles and all start frames.
    (m,).
    """
    return np.array([np.mean([np.mean((velocity[start + lag] - velocity[start]) ** 2)
                              for start in range(len(velocity) - lag)]) for lag in lags])


def increment_flatness(velocity: Sequence[np.ndarray], lags: np.ndarray) -> np.ndarray:
    """Flatness <dv^4> / <dv^2>^2 of the increments dv = v_i(t + lag) - v_i(t) of a component, 3 of normal ones.

    As for `structure_function`; a mean over start frames, so that the decay of a flow does not widen the tails. Not a
    number of a velocity that does not change.
    """
    with np.errstate(invalid="ignore"):
        return np.array([np.mean([_flatness(velocity[start + lag] - velocity[start])
                                  for start in range(len(velocity) - lag)]) for lag in lags])


def _flatness(values: np.ndarray) -> float:
    square = np.square(values, dtype=float)
    return np.mean(square**2) / np.mean(square) ** 2


def minimum_image(displacement: np.ndarray, length: float) -> np.ndarray:
    """Displacement of the nearest periodic image, any shape."""
    return displacement - length * np.rint(displacement / length)


def separations(position: Iterable[np.ndarray], first: np.ndarray, second: np.ndarray,
                length: float) -> Iterator[np.ndarray]:
    """Separation x_first - x_second of pairs over time: frames (n, 3) -> as many (m, 3), frame by frame.

    Positions may be wrapped into the box; separations start as the nearest image and are continuous, as long as none
    changes by more than length / 2 between two frames. `first` and `second` (m,) are rows.
    """
    separation = None
    for frame in position:
        wrapped = frame[first] - frame[second]
        previous = 0.0 if separation is None else separation
        separation = previous + minimum_image(wrapped - previous, length)
        yield separation


def pair_dispersion(position: Iterable[np.ndarray], groups: Sequence[np.ndarray], length: float) -> np.ndarray:
    """Mean-square change of separation <|r(t) - r(0)|^2> of groups of pairs, rows (2, m), which are followed together:
    (frames, n, 3) -> (groups, frames)."""
    paths = separations(position, *np.concatenate(groups, axis=1), length)
    start, ends = next(paths), np.cumsum([pairs.shape[1] for pairs in groups])[:-1]
    spread = [[0.0] * len(groups)]
    for separation in paths:
        squared = np.sum((separation - start) ** 2, axis=1)
        spread.append([np.mean(group) for group in np.split(squared, ends)])
    return np.transpose(spread)


def pairs_at(position: np.ndarray, length: float, distances: Sequence[float], tolerance: float,
             followed: int) -> list[np.ndarray]:
    """Rows (2, m) of the pairs at each distance, within a fraction `tolerance` of it, among particles (n, 3).

    The first of a pair is one of the first `followed` rows, which are compared with all.
    """
    pairs = [[np.empty((2, 0), int)] for _ in distances]
    slabs, reach = _Slabs(position, length), 1.001 * (1 + tolerance) * max(distances, default=0.0)
    for row in range(min(followed, len(position))):
        near, squared = slabs.around(row, reach)
        apart = np.sqrt(squared)
        for distance, found in zip(distances, pairs):
            others = near[np.abs(apart - distance) <= tolerance * distance]
            others = np.sort(others[(others >= followed) | (others > row)])  # each pair once
            found.append(np.stack([np.full(others.size, row), others]))
    return [np.concatenate(found, axis=1) for found in pairs]


def nearest_rows(position: np.ndarray, length: float, chosen: np.ndarray, count: int) -> np.ndarray:
    """Rows of the `count` nearest others of each chosen row (m,) of positions (n, 3), the nearest first: (count, m).

    Raises ValueError where there are no so many others.
    """
    if len(position) <= count:
        raise ValueError(f"{len(position)} particles: none has {count} neighbours")
    slabs, mean_distance = _Slabs(position, length), length / len(position) ** (1 / 3)
    found = np.empty((count, chosen.size), int)
    for number, row in enumerate(chosen):
        reach, near = mean_distance, np.empty(0, int)
        while near.size <= count:
            reach *= 2
            near, squared = slabs.around(row, reach)
        squared[near == row] = -1.0  # before any other in the same place
        found[:, number] = near[np.lexsort((near, squared))[1:count + 1]]
    return found


class _Slabs:
    """Positions (n, 3) in a periodic box, sorted along x, so that those near a plane lie together."""

    def __init__(self, position: np.ndarray, length: float) -> None:
        wrapped = position[:, 0] % length
        rows = np.argsort(wrapped)
        # The box twice, so that a slab that leaves it at one face goes on from there.
        self.rows, self.along = np.tile(rows, 2), np.concatenate([wrapped[rows], wrapped[rows] + length])
        self.components = np.ascontiguousarray(position[self.rows].T)
        self.position, self.length = position, length

    def around(self, row: int, reach: float) -> tuple[np.ndarray, np.ndarray]:
        """Rows within a distance of a row, itself among them, in any order, and their squared distances."""
        first, last, wider = 0, len(self.position), 1.001 * reach  # what is wrapped is rounded
        if wider < self.length / 2:
            low = (self.position[row, 0] - wider) % self.length
            first, last = np.searchsorted(self.along, (low, low + 2 * wider))
        apart = minimum_image(self.components[:, first:last] - self.position[row][:, None], self.length)
        squared = np.sum(apart**2, axis=0)
        inside = squared <= reach**2
        return self.rows[first:last][inside], squared[inside]
