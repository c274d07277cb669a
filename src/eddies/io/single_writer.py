"""Rank 0 as the only writer of a file, where several ranks make it and HDF5 has no MPI, as in the wheels of h5py."""

from __future__ import annotations

import h5py
import numpy as np
from mpi4py import MPI

# Of a product: a frame of it lies on rank 0 as a whole while it is written, and the others wait.
LARGEST_BYTES = 4 * 10**9
REMEDY = ("run on one rank, or build h5py with MPI: `CC=mpicc HDF5_MPI=ON pip install --no-binary=h5py "
          "--no-build-isolation h5py`")


def has_single_writer(comm: MPI.Comm) -> bool:
    """Whether rank 0 writes for all; not so on one rank, which has nobody to write for."""
    return comm.size > 1 and not h5py.get_config().mpi


def gather_frame(comm: MPI.Comm, shape: tuple[int, ...], block: np.ndarray,
                 offset: tuple[int, ...]) -> tuple[np.ndarray, tuple[int, ...]]:
    """A frame of this shape from the blocks of all ranks, each at its offset, and where it begins: whole on rank 0, on
    the others empty. Collective."""
    places = np.empty((comm.size, 2, len(shape)), np.int64)
    comm.Gather(np.array([offset, block.shape], np.int64), places)
    start = (0,) * len(shape)
    if comm.rank > 0:
        if block.size:
            comm.Send(block, 0)
        return np.empty(start, block.dtype), start
    frame = np.zeros(shape, block.dtype)  # as HDF5 would leave what nobody writes
    for rank, (begin, extent) in enumerate(places):
        if extent.all():
            part = block if rank == 0 else np.empty(extent, block.dtype)
            if rank > 0:
                comm.Recv(part, rank)
            frame[tuple(map(slice, begin, begin + extent))] = part
    return frame, start
