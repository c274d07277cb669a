"""Products that are changed, as if a stage had written them so."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import h5py


@contextmanager
def changed(path: str | Path) -> Iterator[h5py.File]:
    """A product to change; one rank calls it."""
    with h5py.File(path, "r+") as file:
        yield file
