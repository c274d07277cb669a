"""Checksums of files: the CRC-32 of every 4096 bytes, in a table behind the end of what HDF5 reads.

They cover all bytes, those of HDF5's own structure too. Bytes of a file that has them are compared before HDF5 sees
them: a reader of some frames compares these alone, on any number of ranks. io/verification.py makes them.
"""

from __future__ import annotations

import itertools
import os
import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
import numpy as np

from eddies.io.errors import ProductError, make_again

BLOCK_BYTES = 2**12
# What follows the table: how many bytes it covers, and a mark.
FOOTER, MARK = struct.Struct("<Q16s"), b"eddies CRC-32 4K"
# The attribute of a file that tells of its table. Where that is gone, another program has cut it off.
ATTRIBUTE = "checksums"
WORDS = f"behind the end of the HDF5 file: CRC-32 of every {BLOCK_BYTES} bytes, as little-endian integers of 4 bytes"
MISSING = "its checksums are missing: it was cut off, or another program has changed it"
PIECE = 2**10  # blocks that are read at once
NAMED = 3  # places that a block may touch


class CheckedFile:
    """A file with checksums as h5py reads it: h5py.File(self, "r").

    Parameters
    ----------
    path : of a file that has checksums.
    naming : whether an error looks for the dataset and frame that are damaged.
    """

    _descriptor: int | None = None  # where the file cannot be opened

    def __init__(self, path: str | Path, naming: bool = True) -> None:
        self.path, self._naming, self._at = Path(path), naming, 0
        self._descriptor = os.open(path, os.O_RDONLY)
        self._size = covered_bytes(self._descriptor) or 0

    def __repr__(self) -> str:
        return str(self.path)  # the name of the file for h5py

    def __del__(self) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)

    def seek(self, offset: int, whence: int = os.SEEK_SET) -> None:
        """Go to a place, as in files."""
        self._at = offset + (self._size if whence == os.SEEK_END else 0)

    def tell(self) -> int:
        """The place."""
        return self._at

    def readinto(self, buffer: memoryview) -> int:
        """Fill a buffer from there on. ProductError, which names dataset and frame, where bytes are not as written."""
        done, size = 0, min(len(buffer), self._size - self._at)
        while done < size:
            first, skipped = divmod(self._at + done, BLOCK_BYTES)
            part = memoryview(buffer)[done:min(size, done + PIECE * BLOCK_BYTES - skipped)]
            wrong = compare(self._descriptor, first, part, self._size, skipped)
            if wrong is not None:
                words = damage_words(self.path, wrong, self._naming)
                raise ProductError(f"{words}; {make_again(self.path.stem)}")
            done += len(part)
        return done

    read = readinto  # h5py wants to see one, and takes the other


def has_checksums(path: str | Path) -> bool:
    """Whether a table of checksums stands at the end of a file; OSError where it cannot be read."""
    with opened(path) as descriptor:
        return covered_bytes(descriptor) is not None


def damage_words(path: Path, block: int, naming: bool = True) -> str:
    """That a block is not what was written, in a line that names file, dataset and frame."""
    start, stop = block * BLOCK_BYTES, (block + 1) * BLOCK_BYTES
    place = f"bytes {start} to {stop}"
    place = f"{_place(path, start, stop)} ({place})" if naming else place
    return f"{path}: {place} is not what was written, the file is damaged"


def count_blocks(size: int) -> int:
    """How many blocks so many bytes fill, the last one perhaps in part."""
    return -(-size // BLOCK_BYTES)


def covered_bytes(descriptor: int) -> int | None:
    """How many bytes the checksums at the end of a file cover; None if there are none."""
    end = os.fstat(descriptor).st_size - FOOTER.size
    size, mark = FOOTER.unpack(os.pread(descriptor, FOOTER.size, end)) if end > 0 else (0, b"")
    return size if mark == MARK and size + 4 * count_blocks(size) == end else None


def compare(descriptor: int, first: int, part: memoryview, size: int, skipped: int = 0) -> int | None:
    """Read a part of a file, of whose bytes `size` are covered, `skipped` bytes after the beginning of block `first`;
    the first block of it that is not as written, None if all are."""
    sums = read_sums(descriptor, first, part, size, skipped)
    wrong = np.flatnonzero(sums != read_table(descriptor, first, first + len(sums), size))
    return first + int(wrong[0]) if wrong.size else None


def read_table(descriptor: int, first: int, last: int, size: int) -> np.ndarray:
    """Checksums of blocks first to last of a file, as they stand behind its `size` bytes."""
    return np.frombuffer(os.pread(descriptor, 4 * (min(last, count_blocks(size)) - first), size + 4 * first), "<u4")


def read_sums(descriptor: int, first: int, part: memoryview, size: int, skipped: int = 0) -> np.ndarray:
    """Read a part of a file as `compare` does; the checksums of its blocks, those that it has in part as a whole."""
    start, end = first * BLOCK_BYTES, first * BLOCK_BYTES + skipped + len(part)
    head, tail = bytearray(skipped), bytearray(min(count_blocks(end) * BLOCK_BYTES, size) - end)
    os.preadv(descriptor, [head, part, tail], start)
    sums = [zlib.crc32(part[:BLOCK_BYTES - skipped], zlib.crc32(head))]
    sums += [zlib.crc32(part[at:at + BLOCK_BYTES]) for at in range(BLOCK_BYTES - skipped, len(part), BLOCK_BYTES)]
    sums[-1] = zlib.crc32(tail, sums[-1])
    return np.array(sums, np.uint32)


@contextmanager
def opened(path: str | Path) -> Iterator[int]:
    """The descriptor of a file that is read."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        yield descriptor
    finally:
        os.close(descriptor)


def _place(path: Path, start: int, stop: int) -> str:
    """Which datasets and frames lie between bytes of a file."""
    found: list[str] = []

    def look(name: str, item: h5py.Group | h5py.Dataset) -> None:
        for row, offset, size in _extents(item) if isinstance(item, h5py.Dataset) else ():
            if offset < stop and start < offset + size:
                rows = item.chunks[0] if item.chunks else 0
                frame = row + max(start - offset, 0) * rows // size
                found.append(f"{name}, frame {frame}" if item.chunks else name)

    try:
        with h5py.File(CheckedFile(path, naming=False), "r") as file:
            file.visititems(look)
    except ProductError:  # the very bytes tell where datasets are
        found.append("the structure of the file, or what lies beside it,")
    return " or ".join(found[:NAMED]) or "the structure of the file"


def _extents(dataset: h5py.Dataset) -> Iterator[tuple[int, int, int]]:
    """First row, offset and bytes of each part of a dataset that lies in the file as one."""
    if dataset.chunks is None:
        if dataset.id.get_offset() is not None:
            yield 0, dataset.id.get_offset(), dataset.nbytes
        return
    for corner in itertools.product(*map(range, itertools.repeat(0), dataset.shape, dataset.chunks)):
        part = dataset.id.get_chunk_info_by_coord(corner)
        if part.byte_offset is not None:
            yield corner[0], part.byte_offset, part.size
