"""Checksums of whole files, which all ranks make and compare together."""

from __future__ import annotations

import zlib
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.io.checksums import (FOOTER, MARK, MISSING, count_blocks, covered_bytes, damage_words, opened, read_blocks,
                                 read_table, sums_of)
from eddies.io.errors import NoRoom
from eddies.parallel.broadcast import on_all_ranks, on_first_rank
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import block_starts

PIECE = 2**10  # blocks that are read at once


def add_checksums(comm: MPI.Comm, path: Path) -> None:
    """Add checksums to a closed file of all ranks; collective. OSError on all ranks."""
    comm.Barrier()  # all have closed it
    size = on_first_rank(comm, lambda: path.stat().st_size)
    table = _sums(comm, path, size).astype("<u4").tobytes() + FOOTER.pack(size, MARK)

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
    """What is wrong with a file, in words that name file, dataset and frame; None if every byte is as written.
    Collective. `known`: its `known_sums` when it was written."""
    def look() -> tuple[int, np.ndarray] | str:
        if not path.is_file():
            return f"{path}: missing"
        with opened(path) as descriptor:
            size = covered_bytes(descriptor)
            if size is None:
                return f"{path}: {MISSING}"
            if known not in (None, known_sums(path)):
                return f"{path}: is another file than was written"
            return size, read_table(descriptor, 0, count_blocks(size), size)

    try:
        found = on_first_rank(comm, look)
        if isinstance(found, str):
            return found
        wrong = np.flatnonzero(_sums(comm, path, found[0]) != found[1])
    except OSError as error:
        return f"{path}: cannot be read ({error})"
    return on_first_rank(comm, lambda: damage_words(path, int(wrong[0]))) if wrong.size else None


def _sums(comm: MPI.Comm, path: Path, size: int) -> np.ndarray:
    """Checksums of the first bytes of a file, of which each rank reads a share; collective. OSError on all ranks."""
    sums = np.zeros(count_blocks(size), np.uint32)
    start, stop = map(int, block_starts(len(sums), comm.size)[comm.rank:comm.rank + 2])

    def read() -> None:
        with opened(path) as descriptor:
            for first in range(start, stop, PIECE):
                last = min(first + PIECE, stop)
                sums[first:last] = sums_of(read_blocks(descriptor, first, last, size))

    on_all_ranks(comm, read)
    return global_sum(comm, sums)
