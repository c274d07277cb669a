"""Checks whether MPI connects the ranks that a launcher has started, and whether all ranks reach the same call."""

import os
import time

from mpi4py import MPI

from eddies.errors import UserError

# Environment variables of launchers: number of ranks, and number of this rank. Only the first one that is set counts,
# because mpirun within a Slurm step inherits the variables of that step.
LAUNCHERS = {"OMPI_COMM_WORLD_SIZE": "OMPI_COMM_WORLD_RANK", "PMI_SIZE": "PMI_RANK",
             "SLURM_STEP_NUM_TASKS": "SLURM_PROCID"}
# Set in the shell of `srun --pty`. A program started there by hand inherits the variables of Slurm, which do not count.
SHELL = "SLURM_PTY_PORT"
PATIENCE = 5.0  # seconds that a rank waits for the others to reach the same error


class NotConnected(UserError):
    """MPI connects fewer ranks than the launcher started. `first` is true if this rank has number 0 in the launcher."""

    def __init__(self, message: str, first: bool) -> None:
        super().__init__(message)
        self.first = first


def require_connected(world: MPI.Comm) -> None:
    """Raise NotConnected if the launcher has started more ranks than `world` has.

    Without a launcher, or if the launcher gives no number of ranks, the check passes.
    """
    names = list(LAUNCHERS)[:1] if SHELL in os.environ else LAUNCHERS
    size = next((name for name in names if os.environ.get(name, "").isdecimal()), None)
    if size is None or int(os.environ[size]) <= world.size:
        return
    library = MPI.Get_library_version().split(",")[0].strip("\0\n ")
    remedy = f"with the mpirun of {library}"
    if size != "OMPI_COMM_WORLD_SIZE" and "SLURM_STEP_NUM_TASKS" in os.environ:
        remedy = f"with `srun --mpi=pmix`, or another type that {library} and `srun --mpi=list` both have"
    raise NotConnected(
        f"{os.environ[size]} ranks were started ({size}), but MPI connects {world.size} of them; start them {remedy}; "
        f"if no launcher was used, unset {size}", os.environ.get(LAUNCHERS[size], "0") == "0")


def all_arrive(comm: MPI.Comm) -> bool:
    """Return whether all ranks call this within PATIENCE seconds; `comm` must serve no other purpose."""
    request, deadline = comm.Ibarrier(), time.monotonic() + PATIENCE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True
