"""Whether all ranks come to the same place."""

from __future__ import annotations

import time

from mpi4py import MPI

PATIENCE = 5.0  # seconds that a rank waits for the others to come to the same error


def all_arrive(comm: MPI.Comm) -> bool:
    """Whether all ranks call this within PATIENCE seconds of each other; `comm` is used for nothing else."""
    request, deadline = comm.Ibarrier(), time.monotonic() + PATIENCE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True
