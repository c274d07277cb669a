"""Products that are changed, as if a stage had written them so."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py
from mpi4py import MPI

from eddies.io.checksums import add_checksums


@contextmanager
def changed(path: str | Path) -> Iterator[h5py.File]:
    """A product to change; one rank calls it. It gets the checksums of what it is then."""
    with h5py.File(path, "r+") as file:
        yield file
    add_checksums(MPI.COMM_SELF, Path(path))
