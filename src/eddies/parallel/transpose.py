"""The global transpose of the slab transform: planes cut along z become planes cut along y."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from eddies.parallel.slab import block_starts


class Transpose:
    """Exchange of arrays (components, z, y, x) between cuts along z and along y, all components in one message.

    `rows` is the length of the full z axis, `columns` of the full y axis. This rank holds z planes `z_starts[rank]`
    to `z_starts[rank + 1]` before `forward` and the same block rule along y after it; `backward` is its inverse and,
    the map being a permutation, its adjoint. One rank sends nothing and copies nothing.
    """

    def __init__(self, comm: MPI.Comm, rows: int, columns: int) -> None:
        self.comm, self.rows, self.columns = comm, rows, columns
        self.z_starts, self.y_starts = block_starts(rows, comm.size), block_starts(columns, comm.size)
        self.z_count = int(self.z_starts[comm.rank + 1] - self.z_starts[comm.rank])
        self.y_count = int(self.y_starts[comm.rank + 1] - self.y_starts[comm.rank])

    def forward(self, planes: np.ndarray) -> np.ndarray:
        """(c, z_count, columns, x) -> (c, rows, y_count, x)."""
        if self.comm.size == 1:
            return planes
        components, _, _, width = planes.shape
        blocks = [planes[:, :, a:b] for a, b in zip(self.y_starts[:-1], self.y_starts[1:])]
        shapes = [(components, b - a, self.y_count, width) for a, b in zip(self.z_starts[:-1], self.z_starts[1:])]
        return np.concatenate(self._exchange(blocks, shapes, planes.dtype), axis=1)

    def backward(self, columns: np.ndarray) -> np.ndarray:
        """(c, rows, y_count, x) -> (c, z_count, columns, x)."""
        if self.comm.size == 1:
            return columns
        components, _, _, width = columns.shape
        blocks = [columns[:, a:b] for a, b in zip(self.z_starts[:-1], self.z_starts[1:])]
        shapes = [(components, self.z_count, b - a, width) for a, b in zip(self.y_starts[:-1], self.y_starts[1:])]
        return np.concatenate(self._exchange(blocks, shapes, columns.dtype), axis=2)

    def _exchange(self, blocks: list[np.ndarray], shapes: list[tuple], dtype: np.dtype) -> list[np.ndarray]:
        sizes_in = np.array([block.size for block in blocks])
        sizes_out = np.array([int(np.prod(shape)) for shape in shapes])
        sent = np.concatenate([block.ravel() for block in blocks])
        received = np.empty(int(sizes_out.sum()), dtype)
        # Counts are in lines along x of all components: in bytes they would leave the range of MPI's integers.
        length = shapes[0][0] * shapes[0][3]
        line = MPI.BYTE.Create_contiguous(length * dtype.itemsize).Commit()
        self.comm.Alltoallv([sent, sizes_in // length, line], [received, sizes_out // length, line])
        line.Free()
        bounds = np.concatenate([[0], np.cumsum(sizes_out)])
        return [received[a:b].reshape(shape) for a, b, shape in zip(bounds[:-1], bounds[1:], shapes)]
