"""One job at a time in a run directory: a file LOCK says which one, and that it is alive.

The file holds host, process and start as JSON; the time of its last change is the job's last sign of life.
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
from dataclasses import asdict, dataclass, fields
from pathlib import Path

from mpi4py import MPI

from eddies.clock import duration
from eddies.errors import UserError
from eddies.io.errors import NoRoom, write_error
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.stop import LOOK_SECONDS, Loss

log = logging.getLogger("eddies")

LOCK = "LOCK"
SIGN_SECONDS = 30.0
STALE_SECONDS = 300.0  # without a sign of life: ten that are missed, as on a file system that hangs for a while
UNREADABLE = "unknown"


class RunInUse(UserError):
    """Another job works in a run directory."""


class RunTakenOver(UserError):
    """Another job has taken a run directory over from this one, which writes nothing more there; on all ranks."""


@dataclass(frozen=True)
class Holder:
    """The job in a run directory: its first rank.

    Parameters
    ----------
    job : a name that no other job has.
    host : name of its machine.
    machine : the machine since its last start, and the processes that see each other there; empty where not known.
    pid : its process.
    born : when that process began, in the units of its machine; empty where not known.
    batch : number of its Slurm job; empty without.
    restarts : how often that job had been queued again.
    start : when it took the directory, UTC.
    """

    job: str
    host: str
    machine: str
    pid: int
    born: str
    batch: str
    restarts: int
    start: str

    @classmethod
    def this_job(cls) -> Holder:
        """The job of this process."""
        restarts = os.environ.get("SLURM_RESTART_COUNT", "")
        return cls(uuid.uuid4().hex, socket.gethostname(), _machine(), os.getpid(), _born(os.getpid()),
                   os.environ.get("SLURM_JOB_ID", ""), int(restarts) if restarts.isdecimal() else 0,
                   datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"))

    def lives(self) -> bool | None:
        """Whether the job is still there; None where this machine cannot know.

        A later life of the same batch job, as after a node that failed, knows that it is gone; its own machine knows
        both.
        """
        own = self.this_job()
        if self.batch and self.batch == own.batch and self.restarts < own.restarts:
            return False
        if not self.machine or self.machine != own.machine:
            return None
        try:
            os.kill(self.pid, 0)
        except ProcessLookupError:
            return False
        except PermissionError:  # another user's
            return True
        return _born(self.pid) == self.born if self.born else None

    def __str__(self) -> str:
        return f"process {self.pid} on {self.host}, since {self.start}"


@dataclass(frozen=True)
class _Found:
    """A lock that was found: whose it is, where, and the last sign of life by the clock of that file system."""

    holder: Holder
    directory: Path
    sign: float

    @property
    def silent(self) -> float:
        """Seconds since the last sign of life."""
        return _now(self.directory) - self.sign

    @property
    def stale(self) -> bool:
        """Whether the job has ended, or has given no sign of life for long where nothing else is known of it."""
        lives = self.holder.lives()
        return self.silent > STALE_SECONDS if lives is None else not lives


class RunLock:
    """The lock of a run directory in the hands of this job, on rank 0; a thread gives the signs of life.

    Parameters
    ----------
    directory : the run directory.
    holder : this job.
    made : whether the directory was made for it; if so, it goes again should nothing have come of the job.
    """

    def __init__(self, directory: Path, holder: Holder, made: bool = False) -> None:
        self.path, self.holder, self.made = directory / LOCK, holder, made
        self._look_at, self._lost_to = 0.0, ""
        self._ended = threading.Event()
        self._signs = threading.Thread(target=self._give_signs, name="run lock", daemon=True)
        self._signs.start()

    def loss(self) -> RunTakenOver | None:
        """What to raise once another job has taken the directory over; looks at most once a second."""
        now = time.monotonic()
        if not self._lost_to and now >= self._look_at:
            self._look_at = now + LOOK_SECONDS
            with contextlib.suppress(OSError):  # a file system that hangs: nothing is known, and other ranks wait
                found = find_lock(self.path.parent)
                if found is not None and found.holder.job not in (self.holder.job, UNREADABLE):
                    self._lost_to = f" ({found.holder})"
                elif _aside(self.path.parent, self.holder).exists():
                    self._lost_to = ", and has ended"
        if not self._lost_to:
            return None
        return RunTakenOver(f"{self.path.parent}: another job has taken this run directory over{self._lost_to}; this "
                            "one ends and leaves all as it is")

    def release(self) -> None:
        """Let others in; the lock of another job stays."""
        self._ended.set()
        self._signs.join()
        if _is_held_by(self.path, self.holder):
            self.path.unlink(missing_ok=True)
        _aside(self.path.parent, self.holder).unlink(missing_ok=True)
        if self.made:
            with contextlib.suppress(OSError):  # it holds work
                self.path.parent.rmdir()

    def _give_signs(self) -> None:
        while not self._ended.wait(SIGN_SECONDS):
            with contextlib.suppress(OSError):  # a file system that hangs; the next sign may get through
                if not self.path.exists() and not _aside(self.path.parent, self.holder).exists():
                    _write(self.path, self.holder)  # somebody has cleaned up
                elif _is_held_by(self.path, self.holder):
                    os.utime(self.path)


@contextlib.contextmanager
def lock_directory(comm: MPI.Comm, directory: Path, take_over: bool = False) -> Iterator[Loss]:
    """Hold a run directory, which is made if need be; all ranks call it. Gives what rank 0 may ask whether it is lost.

    A lock without a sign of life for five minutes, or whose process is known to have ended, counts for nothing, nor,
    with `take_over`, any other: its job finds out at its next step and ends.

    Raises:
        RunInUse: another job works there.
        WriteError: the directory cannot be written.
    """
    lock: list[RunLock] = []  # of rank 0
    try:
        on_first_rank(comm, lambda: lock.append(_take(directory, take_over)))
    except OSError as error:
        raise write_error(directory, error, f"{directory}: cannot be written ({error.strerror}); choose another "
                          "--output") from None
    try:
        yield lock[0].loss if lock else lambda: None
    finally:
        for each in lock:
            with contextlib.suppress(OSError):  # it goes stale by itself
                each.release()


def refuse_if_held(comm: MPI.Comm, directory: Path) -> None:
    """Raise RunInUse where another job works in a run directory; touches nothing. All ranks call it."""
    on_first_rank(comm, lambda: _refuse(directory, find_lock(directory)))


def find_lock(directory: Path) -> _Found | None:
    """The lock in a directory, by whoever holds it; OSError where the file system does not tell."""
    path = directory / LOCK
    try:
        return _Found(_read(path), directory, path.stat().st_mtime)
    except (FileNotFoundError, NotADirectoryError):
        return None


def _refuse(directory: Path, found: _Found | None) -> None:
    if found is not None and not found.stale:
        raise RunInUse(f"{directory}: another job works here ({found.holder}; its last sign of life was "
                       f"{duration(max(found.silent, 0))} ago); wait for its end, or end it by a file STOP there, or "
                       "choose another --output; if it is dead, add --take-over")


def _take(directory: Path, take_over: bool) -> RunLock:
    holder, found = Holder.this_job(), find_lock(directory)
    if not take_over:
        _refuse(directory, found)
    made = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    if found is not None:
        _remove(directory, found.holder)
        log.warning("%s: takes over from a job that %s (%s)", directory,
                    "has ended" if found.stale and found.holder.lives() is False else
                    "has given no sign of life" if found.stale else "may still work there", found.holder)
    try:
        _write(directory / LOCK, holder)
    except FileExistsError:  # another job was quicker
        _refuse(directory, find_lock(directory))
        raise RunInUse(f"{directory}: another job has just been here; run the command again") from None
    return RunLock(directory, holder, made)


def _write(path: Path, holder: Holder) -> None:
    """Write a lock where there is none; FileExistsError where there is one."""
    content = json.dumps(asdict(holder)) + "\n"
    with open(path, "x", encoding="utf-8") as file:
        try:
            file.write(content)
            file.flush()
        except OSError as error:
            path.unlink()
            raise NoRoom.of(error, path, len(content)) from None


def _remove(directory: Path, holder: Holder) -> None:
    """Put the lock of a job aside, where the job finds it should it be alive; if another was quicker, give it its lock
    back."""
    aside = _aside(directory, holder)
    with contextlib.suppress(FileNotFoundError):
        os.replace(directory / LOCK, aside)
        mine = _is_held_by(aside, holder)
        if not mine:
            with contextlib.suppress(OSError):  # of a job that gives itself a new one with its next sign of life
                os.link(aside, directory / LOCK)
        if not mine or holder.job == UNREADABLE or holder.lives() is False:
            aside.unlink()


def _now(directory: Path) -> float:
    """The time by the clock that stamps files there, or by that of this machine where no file can be written."""
    try:
        with tempfile.TemporaryFile(dir=directory) as file:
            file.write(b"now")
            file.flush()
            return os.fstat(file.fileno()).st_mtime
    except OSError:
        return time.time()


def _aside(directory: Path, holder: Holder) -> Path:
    """Where the lock of a job lies once another has taken the directory over."""
    return directory / f"{LOCK}.{holder.job}"


def _is_held_by(path: Path, holder: Holder) -> bool:
    return path.exists() and _read(path).job == holder.job


def _read(path: Path) -> Holder:
    try:
        if path.exists() and not path.is_file():  # reading a pipe would wait for its writer
            raise OSError
        known = json.loads(path.read_text(errors="replace"))
        values = {field.name: known[field.name] for field in fields(Holder)}
        whole = all(type(values[field.name]).__name__ == field.type for field in fields(Holder))
        if not whole or not 0 < values["pid"] < 2**31:
            raise ValueError
        return Holder(**values)
    except (FileNotFoundError, NotADirectoryError):
        raise
    except (OSError, ValueError, KeyError, TypeError):  # another user's, being written, or no lock of a job
        return Holder(UNREADABLE, "an unknown machine", "", 0, "", "", 0, "an unknown time")


def _machine() -> str:
    """This start of this machine and its process numbers, as a container may have its own; empty where not known."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip() + " " + os.readlink("/proc/self/ns/pid")
    except OSError:
        return ""


def _born(pid: int) -> str:
    """When a process of this machine began; empty if there is none, or where that is not known."""
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return ""
    return "" if state[0] in "ZX" else state[19]  # a zombie has ended
