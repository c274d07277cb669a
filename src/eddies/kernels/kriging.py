"""Weights of kriging, and what they tell, by the compiled library."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np

MOST_SCALES = 8
# Of a receiver: its equations are 64 MB then, a vector of them in single precision.
MOST_NEIGHBORS = 1024


class _Kriging(ctypes.Structure):
    _fields_ = ([("receivers", ctypes.c_int64), ("pairs", ctypes.c_int64), ("sited", ctypes.c_int64),
                 ("offsets", ctypes.c_void_p), ("displacement", ctypes.c_void_p), ("support", ctypes.c_double),
                 ("noise", ctypes.c_double),
                 ("most", ctypes.c_int64), ("scales", ctypes.c_int64), ("slowest", ctypes.c_double)]
                + [(name, ctypes.c_void_p) for name in ("amplitudes", "own", "weights")])


class _Told(ctypes.Structure):
    _fields_ = ([(name, ctypes.c_int64) for name in ("receivers", "rows", "columns")]
                + [(name, ctypes.c_void_p) for name in ("offsets", "senders", "own", "weights", "field", "result")])


def kriging_weights(library: ctypes.CDLL, offsets: np.ndarray, displacement: np.ndarray, support: float, noise: float,
                    slowest: float, amplitudes: np.ndarray,
                    sited: bool = True) -> tuple[np.ndarray, list[np.ndarray]]:
    """Weights of the receivers' own values, (10, n), and of their neighbours', ten of (m,), which are small enough for
    memory that is kept: see `eddies.particles.kriging.kriging_weights` for the definition. NaN where a receiver has
    more than MOST_NEIGHBORS.

    Parameters
    ----------
    offsets : int64 (n + 1,), each receiver's pairs.
    displacement : (3, m), x_i - x_j, contiguous, of single or double precision.
    support : beyond which there are no neighbours. noise : variance of what is not part of the field.
    slowest, amplitudes : of the covariance sum_m amplitudes[m] exp(-slowest 2^m r^2), at most eight.
    sited : whether receivers are particles, whose own values count.

    Raises ValueError for arrays of another kind.
    """
    dtype, pairs = displacement.dtype, displacement.shape[-1]
    offsets, amplitudes = np.ascontiguousarray(offsets, np.int64), np.ascontiguousarray(amplitudes, np.float64)
    if (dtype not in (np.float32, np.float64) or displacement.shape != (3, pairs) or len(amplitudes) > MOST_SCALES
            or not displacement.flags.c_contiguous or offsets[-1] != pairs):
        raise ValueError(f"kriging: contiguous displacements (3, {offsets[-1]}) of single or double precision and at "
                         f"most {MOST_SCALES} amplitudes are needed; found {dtype} {displacement.shape} and "
                         f"{len(amplitudes)}")
    own, weights = np.empty((10, len(offsets) - 1), dtype), [np.empty(pairs, dtype) for _ in range(10)]
    rows = np.array([row.ctypes.data for row in weights], np.uint64)
    given = _Kriging(len(offsets) - 1, pairs, sited, offsets.ctypes.data, displacement.ctypes.data, support, noise,
                     MOST_NEIGHBORS, len(amplitudes), slowest,
                     *(array.ctypes.data for array in (amplitudes, own, rows)))
    getattr(library, f"kriging_{dtype}")(ctypes.byref(given))
    return own, weights


def told(library: ctypes.CDLL, offsets: np.ndarray, senders: np.ndarray, own: Sequence[np.ndarray] | None,
         weights: Sequence[np.ndarray], field: np.ndarray) -> np.ndarray:
    """own_i f_i + sum_j weights_ij f_j by one, three, four or ten rows of weights, (n, c, rows).

    Parameters
    ----------
    offsets, senders : int64 (n + 1,) and (m,), each receiver's pairs, and who sends.
    own, weights : rows of (n,) and of (m,), contiguous, of the precision of the field; no `own` of receivers that are
        no particles.
    field : (s, c), contiguous, of single or double precision, the receivers first, if they are particles; no sender is
        beyond it.

    Raises ValueError for arrays of another kind.
    """
    receivers, rows, dtype, sited = len(offsets) - 1, len(weights), field.dtype, own is not None
    own = own if sited else []
    if (rows not in (1, 3, 4, 10) or len(own) != rows * sited or dtype not in (np.float32, np.float64)
            or field.ndim != 2
            or len(field) < receivers * sited or offsets[-1] != len(senders)
            or any(array.dtype != np.int64 or not array.flags.c_contiguous for array in (offsets, senders))
            or any(array.dtype != dtype or not array.flags.c_contiguous for array in (field, *own, *weights))
            or any(row.shape != (receivers,) for row in own) or any(row.shape != senders.shape for row in weights)):
        raise ValueError(f"told: 1, 3, 4 or 10 contiguous rows of weights of {receivers} receivers and {len(senders)} "
                         f"pairs are needed, of the precision of the field; found {len(own)} and {rows}, and a "
                         f"field {dtype} {field.shape}")
    result = np.empty((receivers, field.shape[1], rows), dtype)
    places = [np.array([row.ctypes.data for row in some], np.uint64) for some in (own, weights)]
    given = _Told(receivers, rows, field.shape[1], offsets.ctypes.data, senders.ctypes.data,
                  places[0].ctypes.data if sited else None,
                  *(array.ctypes.data for array in (places[1], field, result)))
    getattr(library, f"told_{dtype}")(ctypes.byref(given))
    return result
