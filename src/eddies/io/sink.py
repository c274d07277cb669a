"""The file below HDF5 where one rank writes alone."""

from __future__ import annotations

import io
from pathlib import Path

from eddies.io.errors import NoRoom


class Sink(io.FileIO):
    """A new file for h5py.File(sink, "w"), which HDF5 always believes to be written.

    HDF5 does not survive a write that fails: it keeps what it could not write and crashes when it closes the file. So
    the first failure is kept in `failure`, later writes are dropped, and whoever wrote asks for it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w+")
        self.path = path
        self.failure: NoRoom | None = None

    def __repr__(self) -> str:
        return str(self.path)  # the name of the file for h5py

    def write(self, data) -> int:
        """Write all bytes, or keep the failure."""
        rest = memoryview(data)
        try:
            while rest and self.failure is None:
                rest = rest[super().write(rest):]
        except OSError as error:
            self.failure = NoRoom.of(error, self.path, len(rest))
        return len(data)

    def truncate(self, size: int | None = None) -> int:
        """Give the file its length, or keep the failure."""
        try:
            return super().truncate(size)
        except OSError as error:
            self.failure = self.failure or NoRoom.of(error, self.path, size or 0)
            return size or 0

    def close(self) -> None:
        """Close the file, or keep the failure: that is when some file systems tell it."""
        try:
            super().close()
        except OSError as error:
            self.failure = self.failure or NoRoom.of(error, self.path, 0)

    def check(self) -> None:
        """Raise the failure, if there was one."""
        if self.failure is not None:
            raise self.failure
