"""Files for other programs: copies, written by one rank, that need no other file and appear once they are whole."""

import json
import math
import os
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from eddies.io.errors import NoRoom, write_error
from eddies.io.hdf5 import write_attributes
from eddies.io.sink import Sink, reserve

OVERHEAD_BYTES = 2**20  # of a file, above its datasets: far more than is needed

Layout = Mapping[str, tuple[tuple[int, ...], Any]]  # shape and type of each large dataset


@contextmanager
def create_export(path: Path, layout: Layout, provenance: Mapping[str, Any], overhead: int = 0) -> Iterator[h5py.File]:
    """A new HDF5 file with empty datasets, with room on the disk for them and for `overhead` bytes of others.

    The file appears under `path` once the block ends well; its directory is made if there is none. `provenance`,
    JSON-able, is stored as in a product.

    Raises:
        ProductError: the file cannot be written, or what the block reads cannot be read.
    """
    partial = path.with_name(path.name + ".partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        bulk = sum(math.prod(shape) * np.dtype(dtype).itemsize for shape, dtype in layout.values())
        size = bulk + OVERHEAD_BYTES + overhead
        sink = Sink(partial)
        with sink, h5py.File(sink, "w") as file:
            try:
                reserve(sink.fileno(), 0, size)  # HDF5 cuts off what it does not need
            except OSError as error:
                raise NoRoom.of(error, partial, size) from None
            write_attributes(file, {"provenance": json.dumps(dict(provenance))})
            for name, (shape, dtype) in layout.items():
                file.create_dataset(name, shape, dtype)
            yield file
        sink.check()
        os.replace(partial, path)
    except OSError as error:
        words = (f"{path}: cannot be written: {error}; check its directory, the space on the disk, and whether the "
                 "product it is made from is whole")
        raise write_error(path, error, words) from None
    finally:
        if partial.is_file():
            partial.unlink()
