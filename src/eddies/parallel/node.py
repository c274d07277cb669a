"""Where a rank stands among those of its node."""

from __future__ import annotations

from mpi4py import MPI


def node_rank(comm: MPI.Comm) -> int:
    """Number of this rank among the ranks that share its memory; collective."""
    return _on_node(comm)[0]


def node_ranks(comm: MPI.Comm) -> int:
    """The most ranks that share a memory; collective."""
    return int(comm.allreduce(_on_node(comm)[1], MPI.MAX))


def _on_node(comm: MPI.Comm) -> tuple[int, int]:
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    place = node.rank, node.size
    node.Free()
    return place
