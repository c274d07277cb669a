"""Whether the threads of all ranks have processors to run on."""

from __future__ import annotations

import logging

from mpi4py import MPI

from eddies.cores import processors, threads, within_quota

log = logging.getLogger("eddies")


def warn_of_few_processors(comm: MPI.Comm) -> None:
    """Log a warning, on rank 0, where a rank of its node takes several threads and has fewer processors; collective."""
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    together = within_quota(set().union(*node.allgather(processors())))
    own, number = max(min(within_quota(processors()), together // node.size), 1), threads()
    if comm.rank == 0 and 1 < number > own:
        log.warning("OMP_NUM_THREADS = %d: each rank has %d of the processors here, so that its threads wait for one "
                    "another; set it to %d, start fewer ranks, or bind each to %d processors (mpirun --map-by "
                    "slot:PE=%d)", number, own, own, number, number)
    node.Free()
