"""What the commands do, for programs: every function takes a scene, its name or its path, and returns
when all is done.

This is the other place, beside the command line, where the communicator of the job enters. All ranks call.
"""

from __future__ import annotations

import logging
import math
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from eddies.cores import check_threads, default_to_one_thread
from eddies.errors import UserError
from eddies.logs import configure_logging
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, load_scene

if TYPE_CHECKING:
    from eddies.parallel.communicator import Comm
    from eddies.parallel.stop import StopRequest

CHECKPOINT_SECONDS = 600.0


def check(scene: Scene | str | Path, *, comm: Comm | None = None) -> None:
    """Log estimates of a scene: resolution, memory, ranks and time. Writes nothing. Raises SceneError where a run would
    be refused."""
    with _job(comm) as comm:
        import_module("eddies.workflows.check").run(_scene(scene), comm)


def run(scene: Scene | str | Path, *, stages: Sequence[str] | None = None, output: str | Path | None = None,
        overwrite: bool = False, variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Run the stages of a scene, all that it has unless some are named, such as "dns" and "train-kernel", in order;
    returns the run directory, `output` or runs/NAME. Of a scene with variants all are run, or those named.

    Stages whose product is complete and was made with the same settings are skipped; work of other settings is replaced
    with `overwrite` alone.

    Raises UserError where a stage is named that there is not, and as `stages.run_stages`.
    """
    return _run(scene, stages, output, overwrite, comm, variants)


def train(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
          variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Train the model of a scene, on the ground truth and with the kernel of the run directory, which it returns; of a
    scene with variants those of all, or of those named."""
    return _run(scene, ("train",), output, overwrite, comm, variants)


def simulate(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
             variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Let the particles of a scene go, from its ground truth, with its trained model if its method needs one; returns
    the run directory, with the new rollout.h5, of a scene with variants one in the directory of each."""
    return _run(scene, ("simulate",), output, overwrite, comm, variants)


def _scene(scene: Scene | str | Path) -> Scene:
    return scene if isinstance(scene, Scene) else load_scene(scene)


def _run(scene: Scene | str | Path, stages: Sequence[str] | None, output: str | Path | None, overwrite: bool,
         comm: Comm | None, variants: Sequence[str]) -> Path:
    unknown = [name for name in stages or () if name not in STAGES]
    if unknown:
        raise UserError(f'stages: there is no "{unknown[0]}"; there are: {", ".join(STAGES)}')
    with _job(comm) as comm:
        scene = _scene(scene)
        directory = Path(output) if output is not None else scene.directory
        from eddies.stages import run_stages
        in_order = [name for name in STAGES if name in (stages or ())]
        run_stages(in_order or scene.stages_of_all, scene, comm, directory, _stop(comm, directory), overwrite,
                   variants=variants)
    return directory


def _stop(comm: Comm, directory: Path) -> StopRequest:
    """What ends a job of a program: a file STOP in its directory alone."""
    from eddies.parallel.stop import StopRequest
    return StopRequest(comm, (), directory / "STOP", math.inf, CHECKPOINT_SECONDS)


@contextmanager
def _job(comm: Comm | None) -> Iterator[Comm]:
    """The communicator of a job, all ranks if None; log lines go to standard output unless the program sends them
    elsewhere, and an error that not all ranks meet ends the job, as the others may wait for ever."""
    default_to_one_thread()
    from mpi4py import MPI

    from eddies.kernels.library import library
    from eddies.parallel.connection import all_arrive, require_connected
    if comm is None:
        comm = MPI.COMM_WORLD
        require_connected(comm)
    if not logging.getLogger("eddies").hasHandlers():
        configure_logging(comm.rank)
    errors = comm.Dup()
    try:
        check_threads()
        library()  # and with it the threads that torch shares
        yield comm
    except BaseException:
        if comm.size > 1 and not all_arrive(errors):
            traceback.print_exc()
            sys.stderr.flush()
            comm.Abort(1)
        errors.Free()
        raise
    else:
        errors.Free()
