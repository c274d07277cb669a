"""Words from one rank to all."""

from __future__ import annotations

import numpy as np
from mpi4py import MPI

from eddies.parallel.reduction import global_min


def share_text(comm: MPI.Comm, text: str, root: int = 0) -> str:
    """The text of rank `root` on every rank. One rank sends nothing."""
    if comm.size == 1:
        return text
    encoded = np.frombuffer(text.encode(), np.uint8)
    length = np.array([len(encoded)], np.int64)
    comm.Bcast(length, root)
    content = encoded.copy() if comm.rank == root else np.empty(length[0], np.uint8)
    comm.Bcast(content, root)
    return content.tobytes().decode()


def first_complaint(comm: MPI.Comm, complaint: str | None) -> str | None:
    """The complaint of the lowest rank that has one, on every rank; None where no rank has."""
    rank = int(global_min(comm, comm.size if complaint is None else comm.rank))
    return None if rank == comm.size else share_text(comm, complaint or "", rank)
