"""Sums, extrema and votes over all ranks. One rank sends nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from mpi4py import MPI
from numpy.typing import ArrayLike


def _reduce(comm: MPI.Comm, value: ArrayLike, operation: MPI.Op) -> np.ndarray:
    result = np.array(value, order="C")
    if comm.size > 1:
        comm.Allreduce(MPI.IN_PLACE, result, op=operation)
    return result


def global_sum(comm: MPI.Comm, value: ArrayLike) -> np.ndarray:
    """Sum of a scalar or array over ranks; a new array of the same shape and type."""
    return _reduce(comm, value, MPI.SUM)


def global_max(comm: MPI.Comm, value: ArrayLike) -> np.ndarray:
    """Element-wise largest value over ranks; a new array of the same shape and type."""
    return _reduce(comm, value, MPI.MAX)


def global_min(comm: MPI.Comm, value: ArrayLike) -> np.ndarray:
    """Element-wise smallest value over ranks; a new array of the same shape and type."""
    return _reduce(comm, value, MPI.MIN)


def any_rank(comm: MPI.Comm, condition: bool) -> bool:
    """Whether the condition holds on at least one rank; the same answer on all."""
    return bool(_reduce(comm, np.int32(bool(condition)), MPI.MAX))


def sum_flat(comm: MPI.Comm, arrays: Sequence[np.ndarray]) -> None:
    """Replace each array (all of one type) by its sum over ranks, in place and in one message.

    This is the gradient sum of data-parallel training: each rank differentiates its own share of one global loss.
    """
    if comm.size == 1 or not arrays:
        return
    flat = np.concatenate([array.ravel() for array in arrays])
    comm.Allreduce(MPI.IN_PLACE, flat, op=MPI.SUM)
    start = 0
    for array in arrays:
        array[...] = flat[start : start + array.size].reshape(array.shape)
        start += array.size
