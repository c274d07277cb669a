"""Errors about files, for users. Each message names the file, the reason and the remedy in one line."""

import errno
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from eddies.errors import UserError
from eddies.pipeline import MAKER_OF

# Error numbers of a full disk, of a used-up quota, and of a file larger than is allowed.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ProductError(UserError, RuntimeError):
    """A product is missing, unfinished, damaged or of the wrong kind."""


class ContentError(ProductError):
    """A file is missing, damaged or not an HDF5 file. With any other ProductError the file may be undamaged."""


class WriteError(ProductError):
    """A file cannot be written. All ranks that write it raise this error at the same place, so they can close and
    remove files together."""


def write_error(path: Path | str, error: OSError, wanted: int = 0) -> WriteError:
    """Return the error for a file that cannot be written, read or removed. `wanted` is the number of bytes to write, or
    0 if it is unknown."""
    reason = error.strerror or error
    if error.errno in NO_ROOM:
        return WriteError(f"{path}: cannot be written: {reason}: {space_in_words(path, wanted)}; make room, then run "
                          "the command again")
    return WriteError(f"{path}: {reason}; check the file, its directory and the space on the disk")


@contextmanager
def file_errors(path: Path | str, wanted: int = 0) -> Iterator[None]:
    """Convert an OSError inside the block to a WriteError. `wanted` is as in `write_error`."""
    try:
        yield
    except OSError as error:
        raise write_error(error.filename or path, error, wanted) from None


def space_in_words(path: Path | str, wanted: int) -> str:
    """Return a text that says how many bytes are free on the file system of `path` and, unless `wanted` is 0, how many
    are wanted."""
    disk = os.statvfs(next(place for place in Path(path).absolute().parents if place.is_dir()))
    free = disk.f_bavail * disk.f_frsize
    if disk.f_files and not disk.f_favail:
        return "no free inodes, so no room for another file"
    return f"{wanted} bytes wanted, {free} free" if wanted else f"{free} bytes free"


@contextmanager
def read_errors(path: Path | str) -> Iterator[None]:
    """Convert an OSError inside the block. It becomes a ContentError if the file is missing or HDF5 finds it damaged.
    Otherwise the system refuses to read the file, and the error becomes a ProductError."""
    try:
        yield
    except OSError as error:
        if error.errno is None:
            raise ContentError(f"{path}: damaged or not an HDF5 file ({error}); make or get it again, or give "
                               "another file") from None
        kind = ContentError if error.errno == errno.ENOENT else ProductError
        raise kind(f"{path}: cannot be read: {os.strerror(error.errno)}; check its permissions, its directory and the "
                   "file system, or give another path") from None


def remedy_for(kind: str, file: str = "it") -> str:
    """Return the remedy, in words, for a product of this `kind` that cannot be used. The stage that makes such a
    product keeps an existing file, so the user has to remove it. `file` is the text that names the file."""
    if kind == "measures":
        return "run `eddies measure` on its directory again"
    return f"remove {file} and run `eddies {MAKER_OF[kind].name}` again" if kind in MAKER_OF else "make it again"
