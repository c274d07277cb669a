"""Orderly stop of all ranks at the same step, by a signal, a file STOP or a limit of wall time."""

import math
import os
import signal
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from mpi4py import MPI

from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.reduction import global_max

LOOK_SECONDS = 1.0  # between two checks for the file: on a network file system a check may take longer than a step

# Votes of the ranks; the largest counts. The vote of a signal is _SIGNALS plus its number.
_NOTHING, _CHECKPOINT, _TIME, _FILE, _SIGNALS = range(5)


class Stopped(Exception):
    """The job stops on request, all ranks at the same place. `then` says what the same command does next time."""

    def __init__(self, reason: str, then: str = "continues after the last finished stage") -> None:
        super().__init__(f"stopped by {reason}; the same command {then}")


class StopRequest:
    """Decides on all ranks whether the job stops or a checkpoint is due. A call costs one small message.

    Parameters
    ----------
    comm : communicator of the job.
    signals : numbers of the signals that this rank has received; a handler appends to this list.
    stop_file : file that rank 0 looks for at most once a second, and removes when the job stops.
    max_seconds : wall time after which the job stops, counted from the construction.
    checkpoint_seconds : wall time between two checkpoints.
    """

    def __init__(self, comm: MPI.Comm, signals: Sequence[int] = (), stop_file: Path | None = None,
                 max_seconds: float = math.inf, checkpoint_seconds: float = math.inf) -> None:
        self.comm, self.signals, self.stop_file = comm, signals, stop_file
        now = time.monotonic()
        self._end, self._interval = now + max_seconds, checkpoint_seconds
        self._checkpoint_at, self._next_look = now + checkpoint_seconds, now
        self._answer = _NOTHING

    def __call__(self) -> bool:
        """Return, on all ranks, whether any rank has a reason to stop; collective."""
        if self._answer <= _CHECKPOINT:
            self._answer = int(global_max(self.comm, self._own_answer()))
            if self._answer > _CHECKPOINT and self.stop_file is not None:
                on_first_rank(self.comm, partial(self.stop_file.unlink, missing_ok=True))
        return self._answer > _CHECKPOINT

    def check(self) -> None:
        """Raise Stopped on all ranks if there is a reason to stop."""
        if self():
            raise Stopped(self.reason)

    @property
    def checkpoint_due(self) -> bool:
        """Whether the last call found that a checkpoint is due or the job is to stop."""
        return self._answer >= _CHECKPOINT

    @property
    def reason(self) -> str:
        """What stops the job, for a message."""
        if self._answer > _SIGNALS:
            return signal.Signals(self._answer - _SIGNALS).name
        return {_FILE: "the file STOP", _TIME: "its limit of wall time"}[self._answer]

    def checkpoint_done(self) -> None:
        """Start the interval to the next checkpoint."""
        self._checkpoint_at = time.monotonic() + self._interval

    def _own_answer(self) -> int:
        if self.signals:
            return _SIGNALS + self.signals[0]
        if self.comm.rank > 0:
            return _NOTHING
        now = time.monotonic()
        if self.stop_file is not None and now >= self._next_look:
            self._next_look = now + LOOK_SECONDS
            if os.path.exists(self.stop_file):  # unlike Path.exists, it never raises an error
                return _FILE
        if now >= self._end:
            return _TIME
        return _CHECKPOINT if now >= self._checkpoint_at else _NOTHING
