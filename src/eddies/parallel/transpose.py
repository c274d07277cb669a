"""The global transpose of the slab transform: planes cut along z become columns cut along y."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from eddies.parallel.slab import block_starts


class Transpose:
    """Exchange of arrays (components, z, y, x) between cuts along z and along y, all components in one message.

    `rows` is the length of the full z axis, `columns` of the full y axis. This rank holds, as planes,
    `z_starts[rank]` to `z_starts[rank + 1]` of z and all of y; as columns, all of z and a block of y by the same rule.
    """

    def __init__(self, comm: MPI.Comm, rows: int, columns: int) -> None:
        self.comm, self.rows, self.columns = comm, rows, columns
        self.z_starts, self.y_starts = block_starts(rows, comm.size), block_starts(columns, comm.size)
        self.z_count = int(self.z_starts[comm.rank + 1] - self.z_starts[comm.rank])
        self.y_count = int(self.y_starts[comm.rank + 1] - self.y_starts[comm.rank])

    def buffers(self, components: int, width: int, dtype: np.dtype) -> TransposeBuffers:
        """Memory for a batch of components with lines of `width` along x, to be filled on one side and sent."""
        return TransposeBuffers(self, components, width, np.dtype(dtype))


class TransposeBuffers:
    """The blocks that ranks exchange, for whoever fills and reads them in place: nothing is packed or unpacked.

    `column_blocks[r]` (components, planes of r, own columns, x) and `plane_blocks[r]` (components, own planes, columns
    of r, x) hold what rank r has on the other side. The own block is the same memory on both sides and is not sent.
    """

    def __init__(self, transpose: Transpose, components: int, width: int, dtype: np.dtype) -> None:
        self._comm, rank = transpose.comm, transpose.comm.rank
        z_counts, y_counts = np.diff(transpose.z_starts), np.diff(transpose.y_starts)
        # Counts are in lines along x of all components: in bytes they would leave the range of MPI's integers.
        self._line = (components * width, dtype)
        self._column_lines, self._plane_lines = z_counts * transpose.y_count, y_counts * transpose.z_count
        shapes: list[tuple[int, ...]] = [(components, int(z), transpose.y_count, width) for z in z_counts]
        own = np.empty(shapes[rank], dtype)
        self._columns, self.column_blocks = _blocks(shapes, dtype, rank, own)
        shapes = [(components, transpose.z_count, int(y), width) for y in y_counts]
        self._planes, self.plane_blocks = _blocks(shapes, dtype, rank, own)
        self._column_lines[rank] = self._plane_lines[rank] = 0

    def to_planes(self) -> None:
        """Send the column blocks to where they are plane blocks; all ranks call it."""
        self._exchange(self._columns, self._column_lines, self._planes, self._plane_lines)

    def to_columns(self) -> None:
        """Send the plane blocks to where they are column blocks, the inverse and adjoint of `to_planes`."""
        self._exchange(self._planes, self._plane_lines, self._columns, self._column_lines)

    def _exchange(self, *arguments: np.ndarray) -> None:
        if self._comm.size > 1:
            self._send(*arguments)

    def _send(self, sent: np.ndarray, sent_lines: np.ndarray, received: np.ndarray, received_lines: np.ndarray) -> None:
        length, dtype = self._line
        line = MPI.BYTE.Create_contiguous(length * dtype.itemsize).Commit()
        self._comm.Alltoallv([sent, sent_lines, line], [received, received_lines, line])
        line.Free()


def _blocks(shapes: list[tuple[int, ...]], dtype: np.dtype, rank: int,
            own: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """The memory that is sent or received, and blocks of the given shapes in it, but for the own one."""
    sizes = [0 if index == rank else int(np.prod(shape)) for index, shape in enumerate(shapes)]
    flat = np.empty(sum(sizes), dtype)
    ends = np.cumsum(sizes)
    return flat, [own if index == rank else flat[ends[index] - sizes[index] : ends[index]].reshape(shape)
                  for index, shape in enumerate(shapes)]
