"""The cores that this process may use, and its number of threads, OMP_NUM_THREADS.

mpi_tools/launch.py imports this module before any package is installed, so it needs the standard library alone.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterable, MutableMapping
from pathlib import Path

from eddies.errors import UserError

CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_NUMBER = "0*[1-9][0-9]*"    # a positive integer for int() and for OpenMP


class ThreadsError(UserError, ValueError):
    """OMP_NUM_THREADS is not a number of threads, or exceeds the processors of this machine."""


def is_positive(text: str) -> bool:
    """Whether a text is a whole number of at least 1."""
    return re.fullmatch(_NUMBER, text) is not None


def threads() -> int:
    """Threads of each rank for kernels, transforms and torch: the first number of OMP_NUM_THREADS, 1 where it is unset
    or empty. Raises ThreadsError where it is not a number of threads."""
    given = os.environ.get("OMP_NUM_THREADS", "").strip() or "1"
    if re.fullmatch(rf"{_NUMBER}(\s*,\s*{_NUMBER})*", given) is None:
        raise ThreadsError(f'OMP_NUM_THREADS = "{given}": must be the number of threads that each rank takes, 1 or '
                           "more; set it to 1, or unset it")
    return int(given.split(",")[0])


def check_threads() -> None:
    """Raise ThreadsError where OMP_NUM_THREADS is not a number of threads, or exceeds this machine's processors."""
    number, there = threads(), os.cpu_count() or 1
    if number > there:
        raise ThreadsError(f"OMP_NUM_THREADS = {number}: this machine has only {there} processors, and more threads "
                           f"slow each other down; set it to {there} or less")


def default_to_one_thread(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set OMP_NUM_THREADS to 1 where it is unset or empty. Otherwise libraries start a thread on every core in every
    rank when they are loaded."""
    if not environment.get("OMP_NUM_THREADS", "").strip():
        environment["OMP_NUM_THREADS"] = "1"


def processors() -> set[int]:
    """Numbers of the logical processors that this process may run on."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def local_cores() -> int:
    """Number of physical cores that this process may use, within its affinity and its container's quota."""
    cores = set()
    for cpu in processors():
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else str(cpu))
    return within_quota(cores)


def within_quota(cores: Iterable[object]) -> int:
    """Number of the given cores that the quota of a container allows to keep busy; at least 1."""
    limit, period = CPU_QUOTA.read_text().split() if CPU_QUOTA.exists() else ("max", "1")
    most = math.inf if limit == "max" else math.ceil(int(limit) / int(period))
    return max(1, min(len(set(cores)), most))
