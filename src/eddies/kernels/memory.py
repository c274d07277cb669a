"""Settings of the C library's memory allocator."""

import ctypes
import os

# Parameters of glibc's mallopt. At most 32 MiB are taken from kept memory; larger blocks are always mapped.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3
KEPT = {MMAP_THRESHOLD: 2**25, TRIM_THRESHOLD: 2**30, TOP_PAD: 2**28}


def keep_freed_memory() -> None:
    """Keep freed memory in this process instead of returning it to the system.

    New pages took a sixth of a turnover of 32^3 particles with kriging. Does nothing if the user has set MALLOC_...
    variables, or with a C library other than glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or any(name.startswith("MALLOC_") for name in os.environ):
        return
    for parameter, value in KEPT.items():
        mallopt(parameter, value)
