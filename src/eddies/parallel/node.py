"""What a rank has of its node: its place among the ranks there, and threads."""

from __future__ import annotations

import os

from mpi4py import MPI


def threads() -> int:
    """Threads of each rank, which kernels, transforms and torch take: OMP_NUM_THREADS, 1 unless set."""
    return int(os.environ.get("OMP_NUM_THREADS", "1"))


def node_rank(comm: MPI.Comm) -> int:
    """Number of this rank among the ranks that share its memory; collective."""
    node = comm.Split_type(MPI.COMM_TYPE_SHARED)
    rank = node.rank
    node.Free()
    return rank
