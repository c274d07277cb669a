"""Text from one rank to all, and work of some ranks whose errors all ranks raise."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from mpi4py import MPI

from eddies.errors import UserError
from eddies.parallel.reduction import global_min

Result = TypeVar("Result")


def share_text(comm: MPI.Comm, text: str, root: int = 0) -> str:
    """Return the text of rank `root` on every rank. The text may hold any bytes, as surrogates."""
    if comm.size == 1:
        return text
    encoded = np.frombuffer(text.encode(errors="surrogateescape"), np.uint8)
    length = np.array([len(encoded)], np.int64)
    comm.Bcast(length, root)
    content = encoded.copy() if comm.rank == root else np.empty(length[0], np.uint8)
    comm.Bcast(content, root)
    return content.tobytes().decode(errors="surrogateescape")


def first_complaint(comm: MPI.Comm, complaint: str | None) -> str | None:
    """Return on every rank the complaint of the lowest rank that has one; None if no rank has one."""
    rank = int(global_min(comm, comm.size if complaint is None else comm.rank))
    return None if rank == comm.size else share_text(comm, complaint or "", rank)


def require_same(comm: MPI.Comm, own: str, words: str) -> None:
    """Raise UserError on all ranks if one was started with another text than rank 0. `words` has a place {} for it."""
    first = share_text(comm, own)
    complaint = first_complaint(comm, None if own == first else (
        f"rank {comm.rank} was started with {words.format(own)}, rank 0 with {words.format(first)}; start all ranks "
        "alike"))
    if complaint is not None:
        raise UserError(complaint)


def on_first_rank(comm: MPI.Comm, action: Callable[[], Result]) -> Result:
    """Run an action on rank 0 only and return its result on every rank. One rank sends nothing.

    All ranks raise the UserError or OSError that it raises.
    """
    result: Any = None
    error: Exception | None = None
    if comm.rank == 0:
        try:
            result = action()
        except (UserError, OSError) as raised:
            error = raised
    if comm.size > 1:
        result, kind, arguments, attributes = comm.bcast((result, type(error), _arguments(error),
                                                          getattr(error, "__dict__", {})))
        if arguments and comm.rank > 0:
            error = kind.__new__(kind, *arguments)  # without __init__, which would build the text again
            error.args = arguments
            vars(error).update(attributes)
    if error is not None:
        raise error
    return result


def on_all_ranks(comm: MPI.Comm, action: Callable[[], Result], kind: type[Exception] = OSError) -> Result:
    """Run an action on all ranks and return its result on this one.

    If it raises an error of this kind on some ranks, all ranks raise it with the text of the lowest of these.
    """
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
    """Return the arguments that give an error the same text on another rank; empty for no error."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno, error.strerror, error.filename and str(error.filename)
    return () if error is None else (str(error),)
