"""Text that one rank sends to all ranks, and actions whose errors are raised on all ranks."""

import time
from collections.abc import Callable
from typing import Any, TypeVar

from mpi4py import MPI

from eddies.errors import UserError
from eddies.parallel.reduction import global_min

Result = TypeVar("Result")
PATIENCE = 5.0  # seconds that a rank waits for the others to meet the same error


def first_complaint(comm: MPI.Comm, complaint: str | None) -> str | None:
    """Return on every rank the complaint of the lowest rank that has one; None if no rank has one."""
    rank = int(global_min(comm, comm.size if complaint is None else comm.rank))
    return None if rank == comm.size else comm.bcast(complaint, rank)


def require_same(comm: MPI.Comm, own: str, words: str) -> None:
    """Raise UserError on all ranks if the text `own` of one rank differs from that of rank 0.

    `words` describes the text in the message of the error; {} in it stands for the text.
    """
    first = on_first_rank(comm, lambda: own)
    complaint = first_complaint(comm, None if own == first else (
        f"rank {comm.rank} was started with {words.format(own)}, rank 0 with {words.format(first)}; start all ranks "
        "alike"))
    if complaint is not None:
        raise UserError(complaint)


def on_first_rank(comm: MPI.Comm, action: Callable[[], Result]) -> Result:
    """Run an action on rank 0 only and return its result on every rank. With a single rank no message is sent.

    If the action raises UserError or OSError, all ranks raise this error.
    """
    result: Any = None
    error: Exception | None = None
    if comm.rank == 0:
        try:
            result = action()
        except (UserError, OSError) as raised:
            error = raised
    if comm.size > 1:
        result, error = comm.bcast((result, error))
    if error is not None:
        raise error
    return result


def on_all_ranks(comm: MPI.Comm, action: Callable[[], Result], kind: type[Exception] = OSError) -> Result:
    """Run an action on all ranks; each rank returns its own result.

    If some ranks raise an error of class `kind`, all ranks raise it, with the text of the lowest of these ranks.
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


def all_arrive(comm: MPI.Comm) -> bool:
    """Return whether all ranks call this within PATIENCE seconds; `comm` must serve no other purpose."""
    request, deadline = comm.Ibarrier(), time.monotonic() + PATIENCE
    while not request.Test():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True
