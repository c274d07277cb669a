"""Words from one rank to all, and work that only some ranks do: what goes wrong on one is raised by all."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from eddies.errors import UserError
from eddies.parallel.reduction import global_min

Result = TypeVar("Result")


def share_text(comm: MPI.Comm, text: str, root: int = 0) -> str:
    """The text of rank `root` on every rank, such as an argument of any bytes. One rank sends nothing."""
    if comm.size == 1:
        return text
    encoded = np.frombuffer(text.encode(errors="surrogateescape"), np.uint8)
    length = np.array([len(encoded)], np.int64)
    comm.Bcast(length, root)
    content = encoded.copy() if comm.rank == root else np.empty(length[0], np.uint8)
    comm.Bcast(content, root)
    return content.tobytes().decode(errors="surrogateescape")


def first_complaint(comm: MPI.Comm, complaint: str | None) -> str | None:
    """The complaint of the lowest rank that has one, on every rank; None where no rank has."""
    rank = int(global_min(comm, comm.size if complaint is None else comm.rank))
    return None if rank == comm.size else share_text(comm, complaint or "", rank)


def require_same(comm: MPI.Comm, own: str, words: str) -> None:
    """Refuse ranks that were started with something else than rank 0; `words` say what, with a place {} for it.

    Raises UserError, on all ranks.
    """
    first = share_text(comm, own)
    complaint = first_complaint(comm, None if own == first else (
        f"rank {comm.rank} was started with {words.format(own)}, rank 0 with {words.format(first)}; start all ranks "
        "alike"))
    if complaint is not None:
        raise UserError(complaint)


def on_first_rank(comm: MPI.Comm, action: Callable[[], Result]) -> Result:
    """What an action gives on rank 0, the only one that does it, on every rank. All ranks raise
    the UserError or OSError that it raises there. One rank sends nothing."""
    result: Any = None
    error: Exception | None = None
    if comm.rank == 0:
        try:
            result = action()
        except (UserError, OSError) as raised:
            error = raised
    if comm.size > 1:
        result, kind, arguments, known = comm.bcast((result, type(error), _arguments(error), getattr(
            error, "__dict__", {})))
        if arguments and comm.rank > 0:
            error = kind.__new__(kind, *arguments)  # not made anew: the text is all there, for each class another way
            error.args = arguments
            vars(error).update(known)
    if error is not None:
        raise error
    return result


def on_all_ranks(comm: MPI.Comm, action: Callable[[], Result], kind: type[Exception] = OSError) -> Result:
    """What an action gives on this rank. All ranks raise an error of this kind that it raises on some, with the words
    of the lowest of these."""
    result: Any = None
    complaint = None
    try:
        result = action()
    except kind as error:
        complaint = getattr(error, "strerror", None) or str(error)
    complaint = first_complaint(comm, complaint)
    if complaint is not None:
        raise kind(complaint)
    return result


def _arguments(error: Exception | None) -> tuple:
    """What makes an error say the same on another rank; empty for none."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno, error.strerror, error.filename and str(error.filename)
    return () if error is None else (str(error),)
