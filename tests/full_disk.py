"""A limit of the file size for one rank, in place of a full disk."""

import resource
import signal
from contextlib import contextmanager


@contextmanager
def largest_file(comm, size, rank=0):
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    if comm.rank == rank:
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, before)
    comm.Barrier()
