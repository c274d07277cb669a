"""Statistics along trajectories: how long velocities are remembered, how particles spread."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np


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
