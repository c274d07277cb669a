"""Weights of kriging, and sums of neighbours' values with these weights."""

import ctypes
from collections.abc import Sequence

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members, require

# Largest number of neighbours of a receiver. The equations of up to 16 receivers are solved together; with this number
# of neighbours they take 64 MB in single precision.
MOST_NEIGHBORS = 1024


class _Kriging(ctypes.Structure):
    _fields_ = (members(INT, "receivers pairs sited") + members(ADDRESS, "offsets displacement")
                + members(NUMBER, "support noise") + members(INT, "most scales") + members(NUMBER, "slowest")
                + members(ADDRESS, "amplitudes own weights"))


class _Sums(ctypes.Structure):
    _fields_ = members(INT, "receivers rows columns") + members(ADDRESS, "offsets senders own weights field result")


def kriging_weights(offsets: np.ndarray, displacement: np.ndarray, support: float, noise: float, slowest: float,
                    amplitudes: np.ndarray, sited: bool = True) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return the weights of n receivers' own values, (10, n), and of their neighbours' values, ten arrays (m,).

    There are m pairs. `eddies.particles.kriging.kriging_weights` defines the weights. The ten arrays are separate so
    that each is small enough for the allocator to keep its memory when it is freed.

    Parameters
    ----------
    offsets : int64 (n + 1,), first pair of each receiver and, at the end, the number of pairs.
    displacement : (3, m), x_i - x_j from neighbour j to receiver i, contiguous, in single or double precision.
    support : distance beyond which a receiver has no neighbours.
    noise : variance of the part of a value that does not belong to the field.
    slowest, amplitudes : parameters of the covariance sum_k amplitudes[k] exp(-slowest 2^k r^2), at most eight terms.
    sited : whether receivers are particles, which have values of their own.
    """
    dtype, pairs = displacement.dtype, displacement.shape[-1]
    offsets, amplitudes = np.ascontiguousarray(offsets, np.int64), np.ascontiguousarray(amplitudes, np.float64)
    require(displacement, (3, int(offsets[-1])), dtype)
    own, weights = np.empty((10, len(offsets) - 1), dtype), [np.empty(pairs, dtype) for _ in range(10)]
    rows = np.array([address(row) for row in weights], np.uint64)
    given = _Kriging(len(offsets) - 1, pairs, sited, address(offsets), address(displacement), support, noise,
                     MOST_NEIGHBORS, len(amplitudes), slowest, *map(address, (amplitudes, own, rows)))
    getattr(library(), f"kriging_{dtype}")(ctypes.byref(given))
    return own, weights


def weighted_sums(offsets: np.ndarray, senders: np.ndarray, own: Sequence[np.ndarray] | None,
                  weights: Sequence[np.ndarray], field: np.ndarray) -> np.ndarray:
    """Return own_i f_i + sum_j weights_ij f_j, (n, c, rows), for one, three, four or ten rows of weights.

    `offsets` (n + 1,) is as in `kriging_weights`, and `senders` (m,) has the sender of each pair; both are int64. `own`
    has rows (n,), or is None if receivers are not particles; `weights` has rows (m,). `field` (s, c) begins
    with the receivers if these are particles. Raises ValueError for arrays of another shape, type or layout.
    """
    receivers, rows, dtype, sited = len(offsets) - 1, len(weights), field.dtype, own is not None
    own = own if sited else []
    require(offsets, (receivers + 1,), np.int64)
    require(senders, (int(offsets[-1]),), np.int64)
    require(field, (len(field), field.shape[-1]), dtype)
    for row in own:
        require(row, (receivers,), dtype)
    for row in weights:
        require(row, senders.shape, dtype)
    result = np.empty((receivers, field.shape[1], rows), dtype)
    of_own, of_weights = (np.array([address(row) for row in some], np.uint64) for some in (own, weights))
    given = _Sums(receivers, rows, field.shape[1], address(offsets), address(senders),
                  address(of_own) if sited else None, *map(address, (of_weights, field, result)))
    getattr(library(), f"weighted_sums_{dtype}")(ctypes.byref(given))
    return result
