"""The type of the communicator that everything below the command line is given, and where a rank stands on its node."""

from __future__ import annotations

from mpi4py import MPI
from mpi4py.MPI import Comm

__all__ = ["Comm", "node_rank", "node_ranks"]


def node_rank(comm: Comm) -> int:
    """Number of this rank among the ranks that share its memory; collective."""
    return _on_node(comm)[0]


def node_ranks(comm: Comm) -> int:
    """The most ranks that share a memory; collective."""
    return int(comm.allreduce(_on_node(comm)[1], MPI.MAX))


def _on_node(comm: Comm) -> tuple[int, int]:
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    place = node.rank, node.size
    node.Free()
    return place
