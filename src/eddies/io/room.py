"""Room on the disk: taken before it is written, so that a lack of it is met where nothing is lost by it."""

from __future__ import annotations

import errno
import os
import resource

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
