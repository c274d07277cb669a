"""HDF5 files that are read: opened without HDF5's own lock, and what it means where one cannot be opened.

A run directory has a lock of its own (io/run_lock.py), and products get their names once they are complete. HDF5's lock
fails on network file systems that take none, and where another program holds the file.
"""

from __future__ import annotations

import os
from pathlib import Path

import h5py


def open_to_read(path: str | Path) -> h5py.File:
    """An HDF5 file, by whoever it is made; OSError where it cannot be opened."""
    return h5py.File(path, "r", locking=False)


def why_unreadable(error: OSError) -> str | None:
    """Why the system does not let a file be read that may be sound; None where HDF5 finds its content damaged."""
    return None if error.errno is None else os.strerror(error.errno)
