"""What the commands do, for programs: every function takes a scene, or its name or path, and returns when all is done.

This is the other place, beside the command line, where the communicator of the job enters. All ranks call.
"""

from __future__ import annotations

import logging
import math
import os
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from eddies.logs import configure_logging
from eddies.scene.scene import Scene, load_scene

if TYPE_CHECKING:
    from eddies.parallel.communicator import Comm

CHECKPOINT_SECONDS = 600.0


def check(scene: Scene | str | Path, *, comm: Comm | None = None) -> None:
    """Log what a scene amounts to: resolution, memory, ranks and time. Writes nothing."""
    with _job(comm) as comm:
        scene = _scene(scene)
        import_module("eddies.workflows.feasibility").check_feasible(scene.stages, scene, comm)
        import_module("eddies.workflows.check").run(scene, comm)


def run(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
        comm: Comm | None = None) -> Path:
    """Run every stage of a scene, in order, and its report; returns the run directory, `output` or runs/NAME.

    Stages whose product is complete and was made with the same settings are skipped; work of other settings is replaced
    with `overwrite` alone.

    Raises as `stages.run_stages`.
    """
    return _run(scene, None, output, overwrite, comm)


def train(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
          comm: Comm | None = None) -> Path:
    """Train the model of a scene, on the ground truth and with the kernel of the run directory, which it returns."""
    return _run(scene, ("train",), output, overwrite, comm)


def simulate(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
             comm: Comm | None = None) -> Path:
    """Let the particles of a scene go, from its ground truth, with its trained model if its method needs one; returns
    the run directory, with the new rollout.h5."""
    return _run(scene, ("simulate",), output, overwrite, comm)


def _scene(scene: Scene | str | Path) -> Scene:
    return scene if isinstance(scene, Scene) else load_scene(scene)


def _run(scene: Scene | str | Path, stages: Sequence[str] | None, output: str | Path | None, overwrite: bool,
         comm: Comm | None) -> Path:
    with _job(comm) as comm:
        scene = _scene(scene)
        directory = Path(output) if output is not None else scene.directory
        from eddies.parallel.stop import StopRequest
        from eddies.stages import run_stages
        stop = StopRequest(comm, (), directory / "STOP", math.inf, CHECKPOINT_SECONDS)
        run_stages(stages or scene.stages, scene, comm, directory, stop, overwrite)
    return directory


@contextmanager
def _job(comm: Comm | None) -> Iterator[Comm]:
    """The communicator of a job, all ranks if None; log lines go to standard output unless the program sends them
    elsewhere, and an error that not all ranks meet ends the job, as the others may wait for ever."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # else torch takes a thread for every core, in every rank
    from mpi4py import MPI

    from eddies.kernels.library import share_threads
    from eddies.parallel.rendezvous import all_arrive
    comm = MPI.COMM_WORLD if comm is None else comm
    if not logging.getLogger("eddies").hasHandlers():
        configure_logging(comm.rank)
    errors = comm.Dup()
    try:
        share_threads()
        yield comm
    except Exception:
        if comm.size > 1 and not all_arrive(errors):
            traceback.print_exc()
            sys.stderr.flush()
            comm.Abort(1)
        errors.Free()
        raise
    else:
        errors.Free()
