"""The type of a communicator, and functions on the ranks of one node."""

import contextlib
import logging
from collections.abc import Iterator

from mpi4py import MPI
from mpi4py.MPI import Comm

from eddies.cores import processors, threads, within_quota

__all__ = ["Comm", "node_rank", "node_ranks", "warn_of_few_processors"]

log = logging.getLogger("eddies")


def node_rank(comm: Comm) -> int:
    """Return the number of this rank among the ranks of its node; collective."""
    with _node(comm) as node:
        return node.rank


def node_ranks(comm: Comm) -> int:
    """Return the largest number of ranks on one node; collective."""
    with _node(comm) as node:
        return int(comm.allreduce(node.size, MPI.MAX))


def warn_of_few_processors(comm: Comm) -> None:
    """Log a warning on rank 0 if it has several threads and fewer processors than threads; collective.

    Its processors are those that it may use, but at most an equal share of the processors of all ranks on its node.
    """
    with _node(comm) as node:
        together = within_quota(set().union(*node.allgather(processors())))
        own, number = max(min(within_quota(processors()), together // node.size), 1), threads()
    if comm.rank == 0 and 1 < number > own:
        log.warning("OMP_NUM_THREADS = %d exceeds the number of processors of a rank, %d, so threads slow each other "
                    "down; set it to %d, start fewer ranks, or bind each rank to %d processors (mpirun --map-by "
                    "slot:PE=%d)", number, own, own, number, number)


@contextlib.contextmanager
def _node(comm: Comm) -> Iterator[Comm]:
    """Yield the communicator of the ranks that share memory with this one."""
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    yield node
    node.Free()
