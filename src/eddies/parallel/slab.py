"""Slab decomposition: grid planes and particles are distributed over ranks by the same rule.

For Fourier transforms, planes cut along z become columns cut along y.
"""

import numpy as np
from mpi4py import MPI


def block_starts(total: int, parts: int) -> np.ndarray:
    """Return the first index of each of `parts` consecutive blocks of `total` items, then `total`: (parts + 1,).

    The first `total % parts` blocks hold one item more than the others.
    """
    sizes = np.full(parts, total // parts)
    sizes[: total % parts] += 1
    return np.concatenate([[0], np.cumsum(sizes)])


class SlabDecomposition:
    """Slabs of a periodic cube of side `length`, cut along z into blocks of `planes` equal layers.

    A particle is on the rank that owns the grid plane just below it. This rank owns the `count` planes start, ...,
    stop - 1, and the particles with z from `lower` to `upper`. `below` and `above` are the neighbouring ranks.
    """

    def __init__(self, comm: MPI.Comm, length: float, planes: int) -> None:
        self.comm, self.rank, self.size = comm, comm.rank, comm.size
        self.length, self.planes = float(length), int(planes)
        self.spacing = self.length / self.planes
        self.starts = block_starts(self.planes, self.size)
        self.start, self.stop = int(self.starts[self.rank]), int(self.starts[self.rank + 1])
        self.count = self.stop - self.start
        self.lower, self.upper = self.start * self.spacing, self.stop * self.spacing
        self.below, self.above = (self.rank - 1) % self.size, (self.rank + 1) % self.size
        self._owner = np.repeat(np.arange(self.size), np.diff(self.starts))

    def owner_of(self, z: np.ndarray) -> np.ndarray:
        """Return the rank that owns each coordinate `z` in [0, length)."""
        plane = np.floor(np.asarray(z) / self.spacing).astype(np.int64)
        # z just below `length` may round up to a plane that does not exist.
        return self._owner[np.clip(plane, 0, self.planes - 1)]


class Transpose:
    """Buffers in which ranks exchange an array (components, z, y, x), in one message each way.

    A rank holds either planes (a block of z, all of y) or columns (all of z, a block of y). `block_starts` defines the
    blocks. For each rank r there are `column_blocks[r]` (components, planes of r, own columns, x) and
    `plane_blocks[r]` (components, own planes, columns of r, x), which callers fill and read in place. A rank's own
    block is the same memory in both lists.

    Parameters
    ----------
    comm : communicator.
    rows, columns : lengths of the z and the y axis.
    components, width : number of components, and length of a line along x.
    dtype : type of the numbers.
    """

    def __init__(self, comm: MPI.Comm, rows: int, columns: int, components: int, width: int, dtype: np.dtype) -> None:
        self._comm, rank, dtype = comm, comm.rank, np.dtype(dtype)
        z_counts, y_counts = np.diff(block_starts(rows, comm.size)), np.diff(block_starts(columns, comm.size))
        # Counts are in lines along x with all components: counts in bytes would exceed the range of MPI's integers.
        self._line_bytes = components * width * dtype.itemsize
        self._column_lines, self._plane_lines = z_counts * y_counts[rank], y_counts * z_counts[rank]
        self._column_lines[rank] = self._plane_lines[rank] = 0
        own = np.empty((components, z_counts[rank], y_counts[rank], width), dtype)
        self._columns, self.column_blocks = _blocks(
            [(components, z, y_counts[rank], width) for z in z_counts], rank, own)
        self._planes, self.plane_blocks = _blocks(
            [(components, z_counts[rank], y, width) for y in y_counts], rank, own)

    def to_planes(self) -> None:
        """Send column block r to rank r, where it becomes a plane block; collective."""
        self._exchange(self._columns, self._column_lines, self._planes, self._plane_lines)

    def to_columns(self) -> None:
        """Send plane block r to rank r, where it becomes a column block: inverse and adjoint of `to_planes`."""
        self._exchange(self._planes, self._plane_lines, self._columns, self._column_lines)

    def _exchange(self, sent: np.ndarray, sent_lines: np.ndarray, received: np.ndarray,
                  received_lines: np.ndarray) -> None:
        if self._comm.size == 1:
            return
        line = MPI.BYTE.Create_contiguous(self._line_bytes).Commit()
        self._comm.Alltoallv([sent, sent_lines, line], [received, received_lines, line])
        line.Free()


def _blocks(shapes: list[tuple[int, ...]], rank: int, own: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Return a flat buffer for messages, and its parts as blocks of these shapes. In place of a part, the block of
    `rank` is `own`."""
    sizes = [0 if index == rank else int(np.prod(shape)) for index, shape in enumerate(shapes)]
    flat = np.empty(sum(sizes), own.dtype)
    parts = np.split(flat, np.cumsum(sizes)[:-1])
    return flat, [own if index == rank else part.reshape(shape)
                  for index, (part, shape) in enumerate(zip(parts, shapes))]
