"""Checksums of HDF5 files: the CRC-32 of every 4096 bytes, in a table after the end of the HDF5 data.

The checksums cover all bytes, also those of HDF5's own structure. `open_to_read` opens a file so that each block of
4096 bytes is compared with its checksum before HDF5 reads it. So a rank that reads a few frames checks only the blocks
of these frames. `add_checksums` and `find_damage` process a whole file, each rank a part of the blocks. Only these two
functions import MPI.
"""

from __future__ import annotations

import io
import itertools
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import h5py
import numpy as np

from eddies.io.errors import ContentError, ProductError, WriteError, file_errors, read_errors, remedy_for

if TYPE_CHECKING:
    from mpi4py import MPI

BLOCK_BYTES = 2**12
# What follows the table: the number of bytes that the checksums cover, and a text that shows that there is a table.
FOOTER, MARK = struct.Struct("<Q16s"), b"eddies CRC-32 4K"
# A file with this attribute was written with a table. If the table is missing, the file was cut off or changed later.
ATTRIBUTE = "checksums"
WORDS = f"after the end of the HDF5 data: CRC-32 of every {BLOCK_BYTES} bytes, as little-endian integers of 4 bytes"
MISSING = "its checksums are missing: the file was cut off, or another program has changed it"
PIECE = 2**10  # blocks per read
NAMED = 3  # largest number of datasets that an error names


def open_to_read(path: str | Path) -> h5py.File:
    """Open any HDF5 file for reading. If it has checksums, all bytes that are read are compared with them.

    HDF5's own file lock is not used, because some network file systems do not support it. It is not needed: a run
    directory has a lock, and a product gets its name only when it is complete.

    Raises:
        ContentError: the file is missing or not an HDF5 file, its checksums are missing, or bytes differ from them.
            Later reads from the file raise this error, too.
        ProductError: the system refuses to open the file.
    """
    with read_errors(path):
        with _opened(path) as descriptor:
            checked = _covered_bytes(descriptor) is not None
        if checked:
            return h5py.File(CheckedFile(path), "r")
        file = h5py.File(path, "r", locking=False)
        if ATTRIBUTE in file.attrs:
            file.close()
            raise OSError(MISSING)
        return file


class CheckedFile(io.FileIO):
    """A file object for h5py.File that checks each read. If `naming` is true, errors name the damaged dataset
    and frame."""

    def __init__(self, path: str | Path, naming: bool = True) -> None:
        super().__init__(path)
        self._path, self._naming, self._size = Path(path), naming, _covered_bytes(self.fileno()) or 0

    def __repr__(self) -> str:
        return str(self._path)  # h5py uses it as the name of the file

    def __del__(self) -> None:
        self.close()  # else Python warns that the file was not closed

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> int:
        """Go to a position. The end of the file is the end of the HDF5 data; the checksums come after it."""
        return super().seek(offset + self._size) if whence == os.SEEK_END else super().seek(offset, whence)

    def readinto(self, buffer: memoryview) -> int:
        """Fill a buffer with the bytes from the present position on, and return their number. Raises ContentError if
        bytes differ from their checksums. The position stays as it was, because h5py sets it before each read."""
        at, done = self.tell(), 0
        size = min(len(buffer), self._size - at)
        while done < size:
            first, skipped = divmod(at + done, BLOCK_BYTES)
            part = memoryview(buffer)[done:min(size, done + PIECE * BLOCK_BYTES - skipped)]
            with read_errors(self._path):
                wrong = _first_wrong(self.fileno(), first, part, self._size, skipped)
            if wrong is not None:
                words = _damage(self._path, wrong, self._naming)
                raise ContentError(f"{words}; {remedy_for(self._path.stem)}")
            done += len(part)
        return done


def add_checksums(comm: MPI.Comm, path: Path) -> None:
    """Append checksums to a file that all ranks have closed; collective. If this fails, all ranks raise WriteError."""
    from eddies.parallel.broadcast import on_all_ranks, on_first_rank
    from eddies.parallel.reduction import global_sum
    comm.Barrier()  # all ranks have closed the file
    size = on_first_rank(comm, lambda: path.stat().st_size)
    sums = np.zeros(_count_blocks(size), np.uint32)

    def read() -> None:
        with file_errors(path), _opened(path) as descriptor:
            for first, part in _own_pieces(comm, size):
                own = _read_sums(descriptor, first, part, size)
                sums[first:first + len(own)] = own

    on_all_ranks(comm, read, WriteError)
    table = global_sum(comm, sums).astype("<u4").tobytes() + FOOTER.pack(size, MARK)

    def append() -> None:
        with open(path, "ab") as file:
            file.write(table)

    with file_errors(path, len(table)):
        on_first_rank(comm, append)


def table_checksum(path: Path) -> int | None:
    """Return one checksum over all checksums of a file, to identify the file; None if the file has no checksums."""
    with _opened(path) as descriptor:
        size = _covered_bytes(descriptor)
        return None if size is None else zlib.crc32(_read_table(descriptor, 0, _count_blocks(size), size), size)


def find_damage(comm: MPI.Comm, path: Path, known: int | None = None) -> str | None:
    """Compare a file with its checksums; collective.

    Returns a text that names the file, the dataset and the frame of the first damage, or None if there is no damage.
    `known` is the result of `table_checksum` for the expected file; if it is None, any file with valid checksums is
    accepted. If the system refuses to read the file, so that damage remains unknown, all ranks raise ProductError.
    """
    from eddies.parallel.broadcast import on_all_ranks, on_first_rank
    from eddies.parallel.reduction import global_min

    @read_errors(path)
    def look() -> int | str:
        if not path.is_file():
            return f"{path}: missing"
        with _opened(path) as descriptor:
            size = _covered_bytes(descriptor)
        if size is not None and known not in (None, table_checksum(path)):
            return f"{path}: is not the file that was written, its checksums are different"
        return f"{path}: {MISSING}" if size is None else size

    @read_errors(path)
    def first_wrong() -> int:
        with _opened(path) as descriptor:
            wrong = (_first_wrong(descriptor, first, part, size) for first, part in _own_pieces(comm, size))
            return next((block for block in wrong if block is not None), _count_blocks(size))

    size = on_first_rank(comm, look)
    if isinstance(size, str):
        return size
    block = int(global_min(comm, on_all_ranks(comm, first_wrong, ProductError)))
    with read_errors(path):
        return on_first_rank(comm, lambda: _damage(path, block)) if block < _count_blocks(size) else None


@contextmanager
def _opened(path: str | Path) -> Iterator[int]:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _count_blocks(size: int) -> int:
    return -(-size // BLOCK_BYTES)


def _covered_bytes(descriptor: int) -> int | None:
    """Return the number of bytes that the checksums cover; None if the file has no checksums."""
    end = os.fstat(descriptor).st_size - FOOTER.size
    size, mark = FOOTER.unpack(os.pread(descriptor, FOOTER.size, end)) if end > 0 else (0, b"")
    return size if mark == MARK and size + 4 * _count_blocks(size) == end else None


def _own_pieces(comm: MPI.Comm, size: int) -> Iterator[tuple[int, memoryview]]:
    """Divide this rank's blocks of the first `size` bytes of a file into pieces. Yield for each piece the number of its
    first block and a buffer for its bytes."""
    from eddies.parallel.slab import block_starts
    start, stop = map(int, block_starts(_count_blocks(size), comm.size)[comm.rank:comm.rank + 2])
    buffer = memoryview(bytearray(PIECE * BLOCK_BYTES))
    for first in range(start, stop, PIECE):
        yield first, buffer[:min(size, stop * BLOCK_BYTES) - first * BLOCK_BYTES]


def _first_wrong(descriptor: int, first: int, part: memoryview, size: int, skipped: int = 0) -> int | None:
    """Fill `part` as `_read_sums` does. Return the number of the first block with a wrong checksum, or None."""
    sums = _read_sums(descriptor, first, part, size, skipped)
    wrong = np.flatnonzero(sums != _read_table(descriptor, first, first + len(sums), size))
    return first + int(wrong[0]) if wrong.size else None


def _read_table(descriptor: int, first: int, last: int, size: int) -> np.ndarray:
    """Return the stored checksums of the blocks first, ..., last - 1. They cover the first `size` bytes of the file."""
    return np.frombuffer(os.pread(descriptor, 4 * (min(last, _count_blocks(size)) - first), size + 4 * first), "<u4")


def _read_sums(descriptor: int, first: int, part: memoryview, size: int, skipped: int = 0) -> np.ndarray:
    """Fill `part` with bytes of a file, starting `skipped` bytes after the beginning of block `first`. The checksums
    cover the first `size` bytes of the file. Returns the computed checksums of all blocks that `part` touches."""
    start, end = first * BLOCK_BYTES, first * BLOCK_BYTES + skipped + len(part)
    head, tail = bytearray(skipped), bytearray(min(_count_blocks(end) * BLOCK_BYTES, size) - end)
    os.preadv(descriptor, [head, part, tail], start)
    sums = [zlib.crc32(part[:BLOCK_BYTES - skipped], zlib.crc32(head))]
    sums += [zlib.crc32(part[at:at + BLOCK_BYTES]) for at in range(BLOCK_BYTES - skipped, len(part), BLOCK_BYTES)]
    sums[-1] = zlib.crc32(tail, sums[-1])
    return np.array(sums, np.uint32)


def _damage(path: Path, block: int, naming: bool = True) -> str:
    start, stop = block * BLOCK_BYTES, (block + 1) * BLOCK_BYTES
    place = f"bytes {start} to {stop}"
    place = f"{_place(path, start, stop)} ({place})" if naming else place
    return f"{path}: the file is damaged: wrong checksum of {place}"


def _place(path: Path, start: int, stop: int) -> str:
    """Return the names of the datasets and frames that have bytes between `start` and `stop` of a file."""
    names: list[str] = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        for row, offset, size in _extents(item) if isinstance(item, h5py.Dataset) else ():
            if offset < stop and start < offset + size:
                rows = item.chunks[0] if item.chunks else 0
                frame = row + max(start - offset, 0) * rows // size
                names.append(f"{name}, frame {frame}" if item.chunks else name)

    try:
        with h5py.File(CheckedFile(path, naming=False), "r") as file:
            file.visititems(look)
    except ContentError:  # HDF5 needs the damaged bytes to find the datasets
        names.append("the structure of the file, or data beside it")
    return " or ".join(names[:NAMED]) or "the structure of the file"


def _extents(dataset: h5py.Dataset) -> Iterator[tuple[int, int, int]]:
    """Yield, for each contiguous part of a dataset, its first row, its offset in the file and its number of bytes."""
    if dataset.chunks is None:
        if dataset.id.get_offset() is not None:
            yield 0, dataset.id.get_offset(), dataset.nbytes
        return
    for corner in itertools.product(*map(range, itertools.repeat(0), dataset.shape, dataset.chunks)):
        part = dataset.id.get_chunk_info_by_coord(corner)
        if part.byte_offset is not None:
            yield corner[0], part.byte_offset, part.size
