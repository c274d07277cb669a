"""What is wrong with a file, for its user."""

from __future__ import annotations

import errno
import os
from pathlib import Path

from eddies.errors import UserError
from eddies.pipeline import MAKER_OF

# A full disk, a used up quota, a file that is longer than it may be.
NO_ROOM = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


class ProductError(UserError, RuntimeError):
    """A product is missing, unfinished, damaged or of the wrong kind: the text says which and what to do."""


class WriteError(ProductError):
    """A file cannot be written. All ranks that write it raise this at the same place, so that they can end other files
    together."""


class NoRoom(OSError):
    """An OSError that knows how many bytes were `wanted`."""

    wanted = 0

    @classmethod
    def of(cls, error: OSError, path: Path | str, wanted: int) -> NoRoom:
        """What was met when so many bytes were wanted for a file."""
        found = cls(error.errno, error.strerror, str(path))
        found.wanted = wanted
        return found


def write_error(path: Path | str, error: OSError, otherwise: str) -> WriteError:
    """The error of a file that cannot be written: where room lacks, with the bytes wanted and free, or `otherwise`."""
    if error.errno not in NO_ROOM:
        return WriteError(otherwise)
    path = error.filename or path
    lack = wanted_and_free(path, getattr(error, "wanted", 0))
    return WriteError(f"{path}: cannot be written: {error.strerror}: {lack}; make room, then run the command again")


def wanted_and_free(path: Path | str, wanted: int) -> str:
    """Bytes wanted for a file, and those free where it is."""
    disk = os.statvfs(next(place for place in Path(path).absolute().parents if place.is_dir()))
    return f"{wanted} bytes wanted, {disk.f_bavail * disk.f_frsize} free"


def make_again(kind: str) -> str:
    """What to do with a product that is of no use; as it is there, its stage would keep it."""
    return f"remove it and run `eddies {MAKER_OF[kind].name}` again" if kind in MAKER_OF else "make it again"
