"""HDF5 files that are read: compared with their checksums, where they have some, without HDF5's own lock; and what it
means where one cannot be opened.

A run directory has a lock of its own (io/run_lock.py), and products get their names once they are complete. HDF5's lock
fails on network file systems that take none, and where another program holds the file.
"""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

import h5py

from eddies.io.checksums import ATTRIBUTE, MISSING, CheckedFile, has_checksums


def open_to_read(path: str | Path) -> h5py.File:
    """An HDF5 file, by whoever it is made.

    Raises OSError where it cannot be opened, and, here and at whatever is read of it, ProductError where bytes are not
    those that its checksums tell of.
    """
    if not stat.S_ISREG(os.stat(path).st_mode):  # opening a pipe would wait for its writer
        raise OSError(errno.EINVAL, "not a regular file", str(path))
    if has_checksums(path):
        return h5py.File(CheckedFile(path), "r")
    file = h5py.File(path, "r", locking=False)
    if ATTRIBUTE in file.attrs:
        file.close()
        raise OSError(MISSING)
    return file


def cannot_be_read(path: str | Path, reason: str) -> str:
    """That the system does not let a file be read, with what to look at."""
    return (f"{path}: cannot be read: {reason}; check its permissions, its directory and the file system, or give "
            "another path")


def why_unreadable(error: OSError) -> str | None:
    """Why the system does not let a file be read that may be sound; None where HDF5 finds its content damaged."""
    return None if error.errno is None else os.strerror(error.errno)
