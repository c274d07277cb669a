"""Statistics along trajectories: how long velocities are remembered, how particles spread."""

import numpy as np


def velocity_correlation(initial: np.ndarray, later: np.ndarray) -> float:
    """Lagrangian velocity correlation <v(0).v(t)> / sqrt(<v(0)^2> <v(t)^2>): both (n, 3), by particle."""
    return float(np.sum(initial * later) / np.sqrt(np.sum(initial**2) * np.sum(later**2)))


def velocity_autocorrelation(velocity: np.ndarray) -> np.ndarray:
    """Correlation of every frame with the first one: (frames, n, 3) -> (frames,), from 1."""
    return np.array([velocity_correlation(velocity[0], frame) for frame in velocity])


def structure_function(velocity: np.ndarray, lags: np.ndarray) -> np.ndarray:
    """Second-order Lagrangian structure function <|v(t + lag) - v(t)|^2> / 3 per component.

    velocity (frames, n, 3) at equal intervals, lags (m,) in frames; mean over particles and all start frames.
    (m,).
    """
    return np.array([np.mean((velocity[lag:] - velocity[: len(velocity) - lag]) ** 2) for lag in lags])


def minimum_image(displacement: np.ndarray, length: float) -> np.ndarray:
    """Displacement of the nearest periodic image, any shape."""
    return displacement - length * np.rint(displacement / length)


def unwrapped(position: np.ndarray, length: float) -> np.ndarray:
    """Continuous trajectories from wrapped ones (frames, n, 3); no step may be longer than length / 2."""
    steps = minimum_image(np.diff(position, axis=0), length)
    return position[0] + np.concatenate([np.zeros_like(position[:1]), np.cumsum(steps, axis=0)])


def pair_dispersion(position: np.ndarray, first: np.ndarray, second: np.ndarray, length: float) -> np.ndarray:
    """Mean-square change of separation <|r(t) - r(0)|^2> of the pairs (first, second): (frames, n, 3) ->
    (frames,).

    Positions may be wrapped into the box; `first` and `second` (m,) are rows.
    """
    path = unwrapped(position, length)
    separation = path[:, first] - path[:, second]
    return np.mean(np.sum((separation - separation[0]) ** 2, axis=-1), axis=-1)


def nearest_neighbors(position: np.ndarray, length: float) -> np.ndarray:
    """Row of the nearest other particle, (n, 3) -> (n,). Compares all pairs: for a few thousand particles."""
    squared = np.zeros((len(position), len(position)))
    for component in position.T:
        squared += minimum_image(component[:, None] - component[None, :], length) ** 2
    np.fill_diagonal(squared, np.inf)
    return np.argmin(squared, axis=1)


def neighbor_dispersion(position: np.ndarray, length: float) -> np.ndarray:
    """Pair dispersion of nearest neighbours over their first mean-square separation, (frames,)."""
    first = np.arange(position.shape[1])
    second = nearest_neighbors(position[0], length)
    separation = minimum_image(position[0][first] - position[0][second], length)
    return pair_dispersion(position, first, second, length) / np.mean(np.sum(separation**2, axis=1))
