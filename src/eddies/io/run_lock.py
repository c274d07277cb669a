"""One job at a time in a run directory.

A file LOCK names the job that works there, as JSON. The modification time of LOCK is the job's last sign of life; a
thread of the job renews it. A job holds the directory as long as LOCK names this job. If LOCK names another job or is
gone, the job ends.
"""

from __future__ import annotations

import contextlib
import datetime
import json
import logging
import os
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from mpi4py import MPI

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.errors import NO_ROOM, WriteError, file_errors, write_error
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.stop import LOOK_SECONDS, LockLoss

log = logging.getLogger("eddies")

LOCK = "LOCK"
SIGN_SECONDS = 30.0
STALE_SECONDS = 300.0  # ten missed signs of life, because a file system may hang for a while
SETTLE_SECONDS = 0.5  # within this time, other jobs that have found the same stale lock replace it, too
UNREADABLE = "unknown"


class RunInUse(UserError):
    """Another job works in a run directory."""


class RunTakenOver(UserError):
    """Another job has taken over the run directory of this job; raised on all ranks."""

    def __init__(self, path: Path, by: str = "") -> None:
        super().__init__(f"{path}: another job has taken over this run directory{by}; this job ends and leaves all "
                         "files as they are")


@dataclass(frozen=True)
class Holder:
    """The job that holds a run directory, and the process of its first rank."""

    job: str  # a unique name
    host: str
    machine: str  # boot id of the machine, and process namespace; empty if unknown
    pid: int
    born: str  # start time of the process, in clock ticks since the boot; empty if unknown
    batch: str  # number of the Slurm job, or empty
    restarts: int  # how often Slurm has requeued this job
    start: str  # when the job took the directory, UTC

    @classmethod
    def this_job(cls) -> Holder:
        """Return the `Holder` for the job of this process."""
        restarts = os.environ.get("SLURM_RESTART_COUNT", "")
        return cls(uuid.uuid4().hex, socket.gethostname(), _machine(), os.getpid(), _born(os.getpid()),
                   os.environ.get("SLURM_JOB_ID", ""), int(restarts) if restarts.isdecimal() else 0,
                   datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"))

    def lives(self) -> bool | None:
        """Return whether the job still runs; None if this cannot be known here.

        This is known on the machine of the job. A requeued Slurm job also knows that its earlier run has ended.
        """
        own = self.this_job()
        if self.batch and self.batch == own.batch and self.restarts < own.restarts:
            return False
        if not self.machine or self.machine != own.machine:
            return None
        born = _born(self.pid)
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # a process of another user, which /proc may hide
            if not born:
                return True
        return born == self.born if self.born else None  # the pid may belong to another process by now

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.start}"


@dataclass(frozen=True)
class FoundLock:
    """A lock in a directory. `sign` is the time of the last sign of life by the clock of the file system."""

    holder: Holder
    directory: Path
    sign: float

    @property
    def silent(self) -> float:
        """Seconds since the last sign of life of the job that holds the lock."""
        return _now(self.directory) - self.sign

    @property
    def stale(self) -> bool:
        """Whether the job has ended or, if that is unknown, has given no sign of life for STALE_SECONDS."""
        lives = self.holder.lives()
        return self.silent > STALE_SECONDS if lives is None else not lives


class RunLock:
    """The lock that this job holds, on rank 0. A thread gives signs of life. `made` says whether the job has made the
    directory; `release` then removes the directory, unless it holds files."""

    def __init__(self, directory: Path, holder: Holder, made: bool) -> None:
        self.directory, self.path, self.holder, self.made = directory, directory / LOCK, holder, made
        self._next_look = 0.0
        self._lost: RunTakenOver | None = None
        self._ended = threading.Event()
        self._signs = threading.Thread(target=self._give_signs, name="run lock", daemon=True)
        self._signs.start()

    def lock_lost(self) -> RunTakenOver | None:
        """Return the error to raise if another job has taken over the directory, else None. LOCK is read at most once a
        second."""
        now = time.monotonic()
        if self._lost is None and now >= self._next_look:
            self._next_look = now + LOOK_SECONDS
            with contextlib.suppress(OSError):  # the file system fails for a while: nothing is known
                found = find_lock(self.directory)
                if found is None:
                    self._lost = RunTakenOver(self.directory, ", or has removed its LOCK")
                elif found.holder.job not in (self.holder.job, UNREADABLE):
                    self._lost = RunTakenOver(self.directory, f" ({found.holder})")
        return self._lost

    def release(self) -> None:
        """Remove the lock, unless it belongs to another job."""
        self._ended.set()
        self._signs.join()
        if _is_held_by(self.path, self.holder):
            self.path.unlink(missing_ok=True)
        if self.made:
            with contextlib.suppress(OSError):  # the directory holds files
                self.directory.rmdir()

    def _give_signs(self) -> None:
        while not self._ended.wait(SIGN_SECONDS):
            with contextlib.suppress(OSError):  # the file system fails for a while; the next sign may succeed
                if _is_held_by(self.path, self.holder):
                    os.utime(self.path)


@contextlib.contextmanager
def lock_directory(comm: MPI.Comm, directory: Path, take_over: bool = False) -> Iterator[LockLoss]:
    """Hold a run directory inside the block; collective. The directory is made if it is missing.

    Yields `RunLock.lock_lost` on rank 0, and on other ranks a function that returns None. A stale lock is replaced.
    With `take_over`, any lock is replaced; the job that held the directory then ends at its next step.

    Raises:
        RunInUse: another job works there.
        WriteError: the directory cannot be written.
    """
    locks: list[RunLock] = []  # on rank 0
    try:
        on_first_rank(comm, lambda: locks.append(_take(directory, take_over)))
    except OSError as error:
        raise write_error(directory, error) if error.errno in NO_ROOM else WriteError(
            f"{directory}: cannot be written ({error.strerror}); choose another --output") from None
    try:
        yield locks[0].lock_lost if locks else lambda: None
    finally:
        for lock in locks:
            with contextlib.suppress(OSError):  # the lock becomes stale by itself
                lock.release()


def refuse_if_held(comm: MPI.Comm, directory: Path) -> None:
    """Raise RunInUse if another job works in a run directory; collective. Changes nothing."""
    with file_errors(directory):
        on_first_rank(comm, lambda: _refuse(directory, find_lock(directory)))


def find_lock(directory: Path) -> FoundLock | None:
    """Return the lock in a directory, or None; OSError if the file system fails."""
    path = directory / LOCK
    try:
        return FoundLock(_read(path), directory, path.stat().st_mtime)
    except (FileNotFoundError, NotADirectoryError):
        return None


def _refuse(directory: Path, found: FoundLock | None) -> None:
    if found is not None and not found.stale:
        raise RunInUse(f"{directory}: another job works here ({found.holder}; its last sign of life was "
                       f"{duration(max(found.silent, 0))} ago); wait until it ends, make a file STOP in the "
                       "directory to stop it, or choose another --output; if the job has died, add --take-over")


def _take(directory: Path, take_over: bool) -> RunLock:
    holder, found, path = Holder.this_job(), find_lock(directory), directory / LOCK
    if not take_over:
        _refuse(directory, found)
    made = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    if found is None:
        with contextlib.suppress(FileExistsError):  # another job was quicker
            _write(path, holder)
    else:
        # Of several jobs that replace a stale lock at the same time, the last one holds the directory.
        own = directory / f"{LOCK}.{holder.job}"
        _write(own, holder)
        try:
            os.replace(own, path)
        finally:
            own.unlink(missing_ok=True)
        time.sleep(SETTLE_SECONDS)
    if not _is_held_by(path, holder):
        _refuse(directory, find_lock(directory))
        raise RunInUse(f"{directory}: another job has just used this directory; run the command again")
    if found is not None:
        log.warning("%s: this job takes over from a job that %s (%s)", directory,
                    "has ended" if found.holder.lives() is False else
                    "has given no sign of life" if found.stale else "may still work there", found.holder)
    return RunLock(directory, holder, made)


def _write(path: Path, holder: Holder) -> None:
    """Write a new lock; FileExistsError if the file exists."""
    content = f"{json.dumps(asdict(holder))}\n".encode()
    with open(path, "xb", buffering=0) as file:
        try:
            file.write(content)
        except OSError as error:
            path.unlink()
            raise write_error(path, error, len(content)) from None


def _now(directory: Path) -> float:
    """Return the present time by the clock of the directory's file system. If no file can be written there, the clock
    of this machine is used."""
    try:
        with tempfile.TemporaryFile(dir=directory) as file:
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()


def _is_held_by(path: Path, holder: Holder) -> bool:
    return path.exists() and _read(path).job == holder.job


def _read(path: Path) -> Holder:
    """Return the job that a lock names. The job's name is UNREADABLE if the lock is incomplete or cannot be read."""
    try:
        return Holder(**json.loads(path.read_text()))
    except (FileNotFoundError, NotADirectoryError):
        raise
    except (OSError, ValueError, TypeError):
        return Holder(UNREADABLE, "an unknown machine", "", 0, "", "", 0, "an unknown time")


def _machine() -> str:
    """Return the boot id of this machine and the process namespace, which differs between containers; empty if they are
    unknown."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip() + " " + os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _born(pid: int) -> str:
    """Return the start time of a process of this machine; empty if the process has ended or the time is unknown."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if state[0] in "ZX" else state[19]  # a zombie has ended
