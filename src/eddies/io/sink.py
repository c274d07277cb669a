"""The file below HDF5 where one rank writes alone, and room on the disk: taken before it is written, so that a lack of
it is met where nothing is lost by it."""

from __future__ import annotations

import errno
import io
import os
import resource
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


# Of a file, ample for what HDF5 writes beside the arrays that are counted.
MARGIN_BYTES = 2**19


def reserve(descriptor: int, start: int, stop: int) -> None:
    """Take the bytes start to stop of an open file from the disk; the file is at least that long then.

    Raises OSError where there is no room. Where the file system cannot do it, this looks whether as much is free.
    """
    try:
        os.posix_fallocate(descriptor, start, stop - start)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL):
            raise
        disk = os.fstatvfs(descriptor)
        if disk.f_bavail * disk.f_frsize < stop - start:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC)) from None


def check_limit(size: int) -> None:
    """Raise OSError where this process may not write files of so many bytes."""
    limit = resource.getrlimit(resource.RLIMIT_FSIZE)[0]
    if limit != resource.RLIM_INFINITY and size > limit:
        raise OSError(errno.EFBIG, os.strerror(errno.EFBIG))
