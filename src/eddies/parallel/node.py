"""Where a rank stands among those of its node."""

from __future__ import annotations

from mpi4py import MPI


def node_rank(comm: MPI.Comm) -> int:
    """Number of this rank among the ranks that share its memory; collective."""
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    rank = node.rank
    node.Free()
    return rank
