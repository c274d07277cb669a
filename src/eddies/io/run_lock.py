"""One job at a time in a run directory.

Rank 0 of a job holds a lock of the system, flock, on the file LOCK. The system frees it when the process ends, even if
it is killed. A line in LOCK names host, process and Slurm job. A job that ends in order removes LOCK.

On parallel file systems flock may hold on one host only. So a job is also refused if LOCK has the line of another host,
until the user removes LOCK. If a file system has no flock, users expect eddies to work nevertheless: a warning says so,
and any line in LOCK refuses other jobs.
"""

import contextlib
import errno
import fcntl
import logging
import os
import shlex
import socket
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

from mpi4py import MPI

from eddies.errors import UserError
from eddies.io.errors import NO_ROOM, WriteError, write_error
from eddies.parallel.broadcast import on_first_rank

log = logging.getLogger("eddies")

LOCK = "LOCK"
UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)  # what flock reports on a file system without locks


class RunInUse(UserError):
    """Another job works in a run directory."""


@contextlib.contextmanager
def lock_directory(comm: MPI.Comm, directory: Path) -> Iterator[None]:
    """Hold a run directory inside the block; collective. The directory is made if it is missing.

    Raises:
        RunInUse: another job works there, or may work there on another host.
        WriteError: the directory cannot be written.
    """
    locks: list[FileIO] = []  # on rank 0
    try:
        on_first_rank(comm, lambda: locks.append(_take(directory)))
    except OSError as error:
        raise write_error(directory, error) if error.errno in NO_ROOM else WriteError(
            f"{directory}: cannot be written ({error.strerror}); choose another --output") from None
    try:
        yield
    finally:
        for lock in locks:
            with contextlib.suppress(OSError), lock:  # the next job on this host takes a LOCK that is left
                if _has_name(lock, directory / LOCK):
                    (directory / LOCK).unlink()


def job_in(directory: Path) -> str:
    """Return, in words, which job works in a directory; empty if none does. OSError if the file system fails."""
    try:
        with open(directory / LOCK, "rb", buffering=0) as file:
            granted, line = _lock(file, fcntl.LOCK_SH), _read(file)
    except (FileNotFoundError, NotADirectoryError):
        return ""
    if granted is False:
        return f"in use by {line}"
    return f"may be in use by {line}" if line and not _has_ended(line, granted) else ""


def _take(directory: Path) -> FileIO:
    """Return the file LOCK, locked, with the line of this job."""
    directory.mkdir(parents=True, exist_ok=True)
    path = directory / LOCK
    with contextlib.ExitStack() as unless_taken:
        file = unless_taken.enter_context(open(path, "a+b", buffering=0))
        granted, line = _lock(file, fcntl.LOCK_EX), _read(file)
        if granted is False:
            raise RunInUse(f"{directory}: another job works here ({line or 'it has just begun'}); wait until it ends, "
                           "make a file STOP in the directory to stop it, or choose another --output; if you started "
                           "one job only, MPI does not connect its ranks: use its mpirun, or `srun --mpi=pmix`")
        if not _has_name(file, path):  # the job that held it has just removed it
            return _take(directory)
        if line and not _has_ended(line, granted):  # it may also have locked directories of variants
            left = [str(each) for each in sorted(directory.rglob(LOCK)) if each.read_bytes() == path.read_bytes()]
            raise RunInUse(f"{directory}: a job still works here, or was killed ({line}); if it no longer runs, run "
                           f"`rm {shlex.join(left)}`")
        file.truncate(0)
        file.write(_this_job().encode())
        unless_taken.pop_all()
    if granted is None:
        log.warning("%s: this file system has no locks (flock), so do not start two jobs here at once", directory)
    return file


def _lock(file: FileIO, kind: int) -> bool | None:
    """Lock an open file, if no other process holds it. Return whether the lock was granted; None if the file system has
    no locks."""
    try:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError as error:
        if error.errno in UNSUPPORTED:
            return None
        raise
    return True


def _this_job() -> str:
    batch, restarts = os.environ.get("SLURM_JOB_ID"), os.environ.get("SLURM_RESTART_COUNT", "0")
    return f"{socket.gethostname()}, process {os.getpid()}" + (
        f", Slurm job {batch}, restart {restarts}" if batch else "")


def _has_ended(line: str, granted: bool | None) -> bool:
    """Return whether the job of a line has ended for certain. It has if it ran on this host, which has `granted` its
    lock, or if it is an earlier run of this Slurm job, which was queued again."""
    host, *job = line.split(", ")
    own_host, *own_job = _this_job().split(", ")
    queued_again = job[1:2] == own_job[1:2] != [] and job[2:] != own_job[2:]
    return granted is True and host == own_host or queued_again


def _read(file: FileIO) -> str:
    file.seek(0)
    return " ".join(file.read().decode(errors="replace").split())


def _has_name(file: FileIO, path: Path) -> bool:
    """Return whether an open file still has this name."""
    try:
        return os.path.samestat(os.fstat(file.fileno()), path.stat())
    except FileNotFoundError:
        return False
