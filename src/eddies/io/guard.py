"""Looks on before each step of a run: writes its checkpoints when they are due, and ends it when it is asked to."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any, Protocol

from mpi4py import MPI

from eddies.io.checkpoint import CheckpointDirectory
from eddies.io.frame_segments import FrameSegments
from eddies.parallel.stop import Stopped, StopRequest

log = logging.getLogger("eddies")


class Run(Protocol):
    """What goes on from a checkpoint."""

    @property
    def steps(self) -> int:
        """Steps taken so far."""

    def state_dict(self) -> dict[str, Any]:
        """All that goes on, as `CheckpointDirectory.write` takes it; collective."""


class Guard:
    """Of a run made with settings of a `fingerprint`, whose checkpoints lie in a directory; `of` says in the words of a
    stop what its steps are of. All methods are collective."""

    def __init__(self, comm: MPI.Comm, directory: Path, fingerprint: str, stop: StopRequest | None,
                 of: str = "") -> None:
        self.checkpoints = CheckpointDirectory(comm, directory, fingerprint)
        self.stop, self.of = stop or StopRequest(comm), of

    def __call__(self, run: Run, segments: FrameSegments | None = None) -> None:
        """Look whether something is due; raises Stopped once the checkpoint is safe. `segments` take the frames."""
        stopping = self.stop()
        if self.stop.checkpoint_due:
            self.save(run, segments)
            self.stop.checkpoint_done()
        if stopping:
            raise Stopped(self.stop.reason, f"from step {run.steps}{self.of}")

    def save(self, run: Run, segments: FrameSegments | None = None) -> None:
        """Write a checkpoint of now."""
        began = time.perf_counter()
        if segments is not None:
            segments.close()
        self.checkpoints.write(run.steps, run.state_dict(), () if segments is None else segments.names)
        log.debug("checkpoint of step %d%s: %.3f s", run.steps, self.of, time.perf_counter() - began)
