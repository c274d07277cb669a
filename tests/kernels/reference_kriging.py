"""Kriging weights by dense equations in numpy, one receiver after the other."""

import numpy as np

from eddies.kernels.kriging import MOST_NEIGHBORS
from eddies.particles.kriging import NOISE, covariance
from eddies.particles.context import ENTRIES


def solved(offsets, displacement, support, filter_width, sited=True):
    """The receivers' own weights (10, k) and their neighbours' (10, m) for displacements (m, 3) x_i - x_j; see
    `eddies.particles.kriging.kriging_weights`."""
    offsets, away = np.asarray(offsets), -np.asarray(displacement, float)
    own, others = np.full((10, len(offsets) - 1), np.nan), np.full((10, len(away)), np.nan)
    for receiver, (first, last) in enumerate(zip(offsets[:-1], offsets[1:])):
        if last - first <= MOST_NEIGHBORS:
            places = np.concatenate([np.zeros((int(sited), 3)), away[first:last]])
            weights = _weights(places, support, covariance(filter_width), sited)
            own[:, receiver] = weights[0] if sited else 0
            others[:, first:last] = weights[int(sited):].T
    return own, others


def _weights(places, support, given, sited):
    """Weights (p, 10) of the values at some places relative to the receiver; the first is its own if it is `sited`."""
    distance = np.linalg.norm(places, axis=1)
    noise = NOISE / np.maximum(1 - (distance / support) ** 4, 1e-4)
    apart = np.sum((places[:, None] - places) ** 2, axis=2)
    matrix = derivative(given, apart, 0) + np.diag(noise)
    value, first, second = (derivative(given, distance**2, order) for order in range(3))
    if sited:
        value = np.arange(len(places)) == 0
    right = [value, *(-2 * first * places[:, axis] for axis in range(3)),
             *(4 * second * places[:, j] * places[:, k] + 2 * first * (j == k) for j, k in ENTRIES)]
    weights, ones = np.linalg.solve(matrix, np.transpose(right)), np.linalg.solve(matrix, np.ones(len(places)))
    sums = np.zeros(10)
    sums[0] = not sited
    return weights - np.outer(ones, (weights.sum(0) - sums) / ones.sum()) if len(places) else weights


def derivative(given, square, order):
    """Derivative of C as a function of r^2."""
    slowest, amplitudes = given
    return sum(amplitude * (-slowest * 2**m) ** order * np.exp(-slowest * 2**m * square)
               for m, amplitude in enumerate(amplitudes))
