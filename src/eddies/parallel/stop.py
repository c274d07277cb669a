"""Orderly ends: signals, a file named STOP and a limit of wall time, seen by all ranks at the same step."""

from __future__ import annotations

import contextlib
import math
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from mpi4py import MPI

from eddies.errors import UserError
from eddies.parallel.broadcast import on_first_rank
from eddies.parallel.reduction import global_max

LOOK_SECONDS = 1.0  # between two looks for the file: a look at a network file system may take longer than a step

# What the ranks tell each other, the largest counts: nothing, a checkpoint is due, or why to stop (a signal: its number
# above _SIGNALS), or that the job has no right to go on.
_NOTHING, _CHECKPOINT, _TIME, _FILE, _SIGNALS = range(5)
_LOST = 1000

# What is to be raised, if anything.
Loss = Callable[[], UserError | None]


class Stopped(Exception):
    """The job was asked to end and does so, all ranks at the same place. The next one goes on as `goes_on` says."""

    def __init__(self, reason: str, goes_on: str = "after the last finished stage") -> None:
        super().__init__(f"stopped by {reason}; the same command goes on {goes_on}")


class StopRequest:
    """Asks whether the job is to end, or a checkpoint is due; one small message a call, none on one rank.

    Parameters
    ----------
    comm : communicator of the job
    signals : numbers of the signals that this rank has got so far; a handler appends to it.
    stop_file : rank 0 looks for it, at most once a second, and removes it when the job stops.
    max_seconds : wall time from now on after which the job stops.
    checkpoint_seconds : wall time between two checkpoints.
    """

    def __init__(self, comm: MPI.Comm, signals: Sequence[int] = (), stop_file: Path | None = None,
                 max_seconds: float = math.inf, checkpoint_seconds: float = math.inf) -> None:
        self.comm, self.signals, self.stop_file = comm, signals, stop_file
        now = time.monotonic()
        self._end, self._interval = now + max_seconds, checkpoint_seconds
        self._checkpoint_at, self._look_at = now + checkpoint_seconds, now
        self._answer = _NOTHING
        self._losses: list[Loss] = []

    @contextlib.contextmanager
    def watching(self, loss: Loss) -> Iterator[None]:
        """Within, the next look raises, on all ranks, what `loss` gives on rank 0; nothing is written any more then."""
        self._losses.append(loss)
        try:
            yield
        finally:
            self._losses.remove(loss)

    def __call__(self) -> bool:
        """Whether any rank knows a reason to stop; the same answer on all ranks, which must all call.

        Raises what a loss that is watched gives.
        """
        if self._answer <= _CHECKPOINT:
            self._answer = int(global_max(self.comm, self._own_answer()))
            if self._answer == _LOST:
                on_first_rank(self.comm, self._raise_loss)
            if self._answer > _CHECKPOINT and self.stop_file is not None:
                on_first_rank(self.comm, partial(self.stop_file.unlink, missing_ok=True))
        return self._answer > _CHECKPOINT

    def check(self) -> None:
        """Raise Stopped, on all ranks alike, if there is a reason to stop."""
        if self():
            raise Stopped(self.reason)

    @property
    def checkpoint_due(self) -> bool:
        """Whether the last call found that the time for a checkpoint has come, or that the job is to stop."""
        return self._answer >= _CHECKPOINT

    @property
    def reason(self) -> str:
        """What stops the job, in a word or two."""
        if self._answer > _SIGNALS:
            return signal.Signals(self._answer - _SIGNALS).name
        return {_FILE: "the file STOP", _TIME: "its limit of wall time"}[self._answer]

    def checkpoint_done(self) -> None:
        """Start the time to the next checkpoint."""
        self._checkpoint_at = time.monotonic() + self._interval

    def _raise_loss(self) -> None:
        for error in filter(None, (loss() for loss in self._losses)):
            raise error

    def _own_answer(self) -> int:
        if any(loss() for loss in self._losses):
            return _LOST
        if self.signals:
            return _SIGNALS + self.signals[0]
        if self.comm.rank > 0:
            return _NOTHING
        now = time.monotonic()
        if self.stop_file is not None and now >= self._look_at:
            self._look_at = now + LOOK_SECONDS
            if os.path.exists(self.stop_file):  # raises nothing, which the others would not know of
                return _FILE
        if now >= self._end:
            return _TIME
        return _CHECKPOINT if now >= self._checkpoint_at else _NOTHING
