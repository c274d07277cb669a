"""Files of contiguous global arrays that do not depend on the number of ranks, written by all ranks.

One rank lays the file out with HDF5, then every rank writes its bytes where they belong, by itself: a full disk is an
error of the rank that meets it, and nobody waits for another inside a library.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np

from eddies.io.sink import Sink, reserve

Regions = Mapping[str, Sequence[int]]  # name: offset and number of bytes


@dataclass(frozen=True)
class Block:
    """This rank's part of a global array: rows start, start + 1, ... of `total` along an axis; maybe none."""

    values: np.ndarray
    start: int
    total: int
    axis: int = 0

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the global array."""
        shape = self.values.shape
        return (*shape[:self.axis], self.total, *shape[self.axis + 1:])


def lay_out(path: Path, arrays: Mapping[str, np.ndarray | Block]) -> Regions:
    """Make an HDF5 file with room for all arrays, on one rank; where each lies that is not empty.

    Raises OSError where there is no room.
    """
    regions, sink = {}, Sink(path)
    with sink, h5py.File(sink, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_alloc_time(h5py.h5d.ALLOC_TIME_EARLY)
        plan.set_fill_time(h5py.h5d.FILL_TIME_NEVER)
        for name, array in arrays.items():
            dataset = h5py.h5d.create(file.id, name.encode(), h5py.h5t.py_create(_type(array)),
                                      h5py.h5s.create_simple(array.shape), plan)
            size = _bytes(array)
            if size:
                regions[name] = (dataset.get_offset(), size)
    sink.check()
    with open(path, "r+b") as laid_out:
        reserve(laid_out.fileno(), 0, path.stat().st_size)
    return regions


def total_bytes(arrays: Mapping[str, np.ndarray | Block]) -> int:
    """Bytes of all arrays, those of the other ranks included."""
    return sum(map(_bytes, arrays.values()))


def _bytes(array: np.ndarray | Block) -> int:
    return int(np.prod(array.shape)) * _type(array).itemsize


def _type(array: np.ndarray | Block) -> np.dtype:
    return array.values.dtype if isinstance(array, Block) else array.dtype


def write_arrays(rank: int, path: Path, regions: Regions, arrays: Mapping[str, np.ndarray | Block]) -> None:
    """Write this rank's bytes, down to the disk; rank 0 those of arrays that all ranks hold."""
    with open(path, "r+b", buffering=0) as file:
        for name in regions:
            array = arrays[name]
            if not isinstance(array, Block):
                array = Block(array, 0, len(array)) if rank == 0 else Block(array[:0], 0, len(array))
            _write_block(file.fileno(), regions[name][0], array)
        os.fsync(file.fileno())


def _write_block(file: int, offset: int, block: Block) -> None:
    """One write for each run of rows that lie side by side in the file."""
    if not block.values.size:
        return
    values = np.ascontiguousarray(block.values)
    runs = values.reshape(int(np.prod(values.shape[:block.axis])), -1).view(np.uint8)
    row = runs.shape[1] // block.values.shape[block.axis]
    for number, run in enumerate(runs):
        start, rest = offset + row * (number * block.total + block.start), memoryview(run)
        while rest:
            written = os.pwrite(file, rest, start)
            start, rest = start + written, rest[written:]
