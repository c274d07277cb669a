"""Checksums of whole files, which all ranks make and compare together."""

from __future__ import annotations

import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.io.checksums import (BLOCK_BYTES, FOOTER, MARK, MISSING, PIECE, compare, count_blocks, covered_bytes,
                                 damage_words, opened, read_sums, read_table)
from eddies.io.errors import NoRoom
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.reduction import global_min, global_sum
from eddies.parallel.slab import block_starts


def add_checksums(comm: MPI.Comm, path: Path) -> None:
    """Add checksums to a closed file of all ranks; collective. OSError on all ranks."""
    comm.Barrier()  # all have closed it
    size = on_first_rank(comm, lambda: path.stat().st_size)
    sums = np.zeros(count_blocks(size), np.uint32)

    def read() -> None:
        with opened(path) as descriptor:
            for first, part in _share(comm, size):
                found = read_sums(descriptor, first, part, size)
                sums[first:first + len(found)] = found

    on_all_ranks(comm, read)
    table = global_sum(comm, sums).astype("<u4").tobytes() + FOOTER.pack(size, MARK)

    def append() -> None:
        try:
            with open(path, "ab", buffering=0) as file:
                rest = memoryview(table)
                while rest:
                    rest = rest[file.write(rest):]
        except OSError as error:
            raise NoRoom.of(error, path, len(table)) from None

    on_first_rank(comm, append)


def known_sums(path: Path) -> int | None:
    """A checksum of the checksums of a file, by which it is known; None if it has none. OSError where it cannot be
    read."""
    with opened(path) as descriptor:
        size = covered_bytes(descriptor)
        return None if size is None else zlib.crc32(read_table(descriptor, 0, count_blocks(size), size), size)


def find_damage(comm: MPI.Comm, path: Path, known: int | None = None) -> str | None:
    """Compare a file with its checksums; collective.

    Returns a line that names file, dataset and frame of the first damage, or None. `known`: `known_sums` of the file
    that is expected.
    """
    def look() -> int | str:
        if not path.is_file():
            return f"{path}: missing"
        with opened(path) as descriptor:
            size = covered_bytes(descriptor)
        if size is not None and known not in (None, known_sums(path)):
            return f"{path}: is another file than was written"
        return f"{path}: {MISSING}" if size is None else size

    def first_wrong() -> int:
        with opened(path) as descriptor:
            found = (compare(descriptor, *piece, size) for piece in _share(comm, size))
            return next((block for block in found if block is not None), count_blocks(size))

    try:
        size = on_first_rank(comm, look)
        if isinstance(size, str):
            return size
        block = int(global_min(comm, on_all_ranks(comm, first_wrong)))
    except OSError as error:
        return f"{path}: cannot be read ({error})"
    return on_first_rank(comm, lambda: damage_words(path, block)) if block < count_blocks(size) else None


def _share(comm: MPI.Comm, size: int) -> Iterator[tuple[int, memoryview]]:
    """The share of this rank of the blocks of so many bytes, a few at a time: the first one, and room for them."""
    start, stop = map(int, block_starts(count_blocks(size), comm.size)[comm.rank:comm.rank + 2])
    room = memoryview(bytearray(PIECE * BLOCK_BYTES))
    for first in range(start, stop, PIECE):
        yield first, room[:min(size, stop * BLOCK_BYTES) - first * BLOCK_BYTES]
