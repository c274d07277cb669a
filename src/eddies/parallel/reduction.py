"""Sums, extrema and votes over all ranks. With a single rank no message is sent."""

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
    """Return the sum of a scalar or array over ranks, as a new array of the same shape and type."""
    return _reduce(comm, value, MPI.SUM)


def global_max(comm: MPI.Comm, value: ArrayLike) -> np.ndarray:
    """Return the element-wise maximum over ranks, as a new array of the same shape and type."""
    return _reduce(comm, value, MPI.MAX)


def global_min(comm: MPI.Comm, value: ArrayLike) -> np.ndarray:
    """Return the element-wise minimum over ranks, as a new array of the same shape and type."""
    return _reduce(comm, value, MPI.MIN)


def any_rank(comm: MPI.Comm, condition: bool) -> bool:
    """Return, on every rank, whether the condition holds on at least one rank."""
    return bool(_reduce(comm, np.int32(bool(condition)), MPI.MAX))


def sum_flat(comm: MPI.Comm, arrays: Sequence[np.ndarray]) -> None:
    """Replace each array (all of one type) by its sum over ranks, in place and in one message.

    Data-parallel training sums its gradients in this way: each rank differentiates its share of one global loss.
    """
    if comm.size == 1 or not arrays:
        return
    flat = np.concatenate([array.ravel() for array in arrays])
    comm.Allreduce(MPI.IN_PLACE, flat, op=MPI.SUM)
    for array, total in zip(arrays, np.split(flat, np.cumsum([array.size for array in arrays])[:-1])):
        array[...] = total.reshape(array.shape)
