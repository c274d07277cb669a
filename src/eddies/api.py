"""The commands as Python functions. Each takes a scene, or the name or path of one, and returns when its work is done.

All ranks call a function together. Only this module and `cli` use MPI.COMM_WORLD, the communicator of the job.
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

CHECKPOINT_SECONDS = 600.0


def check(scene: Scene | str | Path, *, comm: Comm | None = None) -> None:
    """Log estimates for a run of a scene: resolution, memory, disk, time step, largest number of ranks. Writes no file.

    Raises SceneError if a run would be refused.
    """
    with _job(comm) as comm:
        import_module("eddies.workflows.check").run(scene if isinstance(scene, Scene) else load_scene(scene), comm)


def run(scene: Scene | str | Path, *, stages: Sequence[str] | None = None, output: str | Path | None = None,
        overwrite: bool = False, variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Run the stages of a scene and return the run directory.

    Parameters
    ----------
    stages : names such as "dns" and "train-kernel"; run in the order of the pipeline. None or empty: all of the scene.
    output : the run directory; None: runs/NAME, where NAME is the name of the scene.
    overwrite : if True, products and checkpoints that were made with other settings are replaced; if False, they are an
        error. Complete products of the same settings are always kept.
    variants : the variants to run; empty for all.
    comm : the communicator; None for all ranks of the job.

    Raises UserError for an unknown stage, and the errors of `stages.run_stages`.
    """
    unknown = [name for name in stages or () if name not in STAGES]
    if unknown:
        raise UserError(f'stages: there is no "{unknown[0]}"; there are: {", ".join(STAGES)}')
    with _job(comm) as comm:
        from eddies.parallel.stop import StopRequest
        from eddies.stages import run_stages
        if not isinstance(scene, Scene):
            scene = load_scene(scene)
        directory = Path(output) if output is not None else scene.directory
        in_order = [name for name in STAGES if name in (stages or ())]
        stop = StopRequest(comm, (), directory / "STOP", math.inf, CHECKPOINT_SECONDS)  # only a file STOP ends the job
        run_stages(in_order or scene.stages_of_all, scene, comm, directory, stop, overwrite, variants=variants)
    return directory


def train(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
          variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Train the model of a scene with the ground truth and kernel in its run directory; arguments as for `run`."""
    return run(scene, stages=("train",), output=output, overwrite=overwrite, variants=variants, comm=comm)


def simulate(scene: Scene | str | Path, *, output: str | Path | None = None, overwrite: bool = False,
             variants: Sequence[str] = (), comm: Comm | None = None) -> Path:
    """Make the rollout of a scene with the ground truth and model in its run directory; arguments as for `run`."""
    return run(scene, stages=("simulate",), output=output, overwrite=overwrite, variants=variants, comm=comm)


@contextmanager
def _job(comm: Comm | None) -> Iterator[Comm]:
    """Context that gives the communicator of a job: `comm`, or that of all ranks if `comm` is None.

    Log lines go to standard output unless the program has set up logging. With several ranks, an error ends the job by
    MPI_Abort in two cases: if only some ranks raise it, because the others may wait for them; and if HDF5 could not
    write a file, because the process would crash at exit.
    """
    default_to_one_thread()
    from mpi4py import MPI

    from eddies.io.new_files import require_parallel_hdf5, writing_failed
    from eddies.kernels.library import library
    from eddies.parallel.broadcast import all_arrive
    if comm is None:
        comm = MPI.COMM_WORLD
    if not logging.getLogger("eddies").hasHandlers():
        configure_logging(comm.rank)
    errors = comm.Dup()
    try:
        require_parallel_hdf5(comm)
        check_threads()
        library()  # sets the threads, which torch shares
        yield comm
    except BaseException:
        if comm.size > 1 and (writing_failed() or not all_arrive(errors)):
            traceback.print_exc()
            sys.stderr.flush()
            comm.Abort(1)
        errors.Free()
        raise
    else:
        errors.Free()
