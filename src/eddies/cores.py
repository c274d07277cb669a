"""The cores that this process may use, and its number of threads, OMP_NUM_THREADS.

mpi_tools/launch.py imports this module before any package is installed. The module therefore uses only the standard
library and `eddies.errors`.
"""

import math
import os
import re
from collections.abc import Iterable, MutableMapping
from pathlib import Path

from eddies.errors import UserError

CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
_NUMBER = "0*[1-9][0-9]*"    # pattern of a positive integer that both int() and OpenMP accept


class ThreadsError(UserError, ValueError):
    """OMP_NUM_THREADS is not a number of threads, or exceeds the processors of this machine."""


def is_positive(text: str) -> bool:
    """Return whether a text is a whole number of at least 1."""
    return re.fullmatch(_NUMBER, text) is not None


def threads() -> int:
    """Return the number of threads that each rank uses for kernels, transforms and torch.

    It is the first number of OMP_NUM_THREADS, or 1 if this variable is unset or empty. Raises ThreadsError if the
    variable is not a number of threads.
    """
    given = os.environ.get("OMP_NUM_THREADS", "").strip() or "1"
    if re.fullmatch(rf"{_NUMBER}(\s*,\s*{_NUMBER})*", given) is None:
        raise ThreadsError(f'OMP_NUM_THREADS = "{given}": must be the number of threads that each rank takes, 1 or '
                           "more; set it to 1, or unset it")
    return int(given.split(",")[0])


def check_threads() -> None:
    """Raise ThreadsError if OMP_NUM_THREADS is not a number of threads, or exceeds the processors of this machine."""
    number, there = threads(), os.cpu_count() or 1
    if number > there:
        raise ThreadsError(f"OMP_NUM_THREADS = {number}: this machine has only {there} processors, and more threads "
                           f"slow each other down; set it to {there} or less")


def default_to_one_thread(environment: MutableMapping[str, str] = os.environ) -> None:
    """Set OMP_NUM_THREADS to 1 if it is unset or empty. Without a value, each rank would start a thread on every core
    when it loads libraries."""
    if not environment.get("OMP_NUM_THREADS", "").strip():
        environment["OMP_NUM_THREADS"] = "1"


def processors() -> set[int]:
    """Return the ids of the logical processors that this process may run on."""
    return os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else set(range(os.cpu_count() or 1))


def local_cores() -> int:
    """Return the number of physical cores that this process may use. Its CPU affinity and the quota of its container
    limit this number."""
    cores = set()
    for cpu in processors():
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else str(cpu))
    return within_quota(cores)


def within_quota(cores: Iterable[object]) -> int:
    """Return how many of the given cores the CPU quota of the container allows to keep busy; at least 1."""
    limit, period = CPU_QUOTA.read_text().split() if CPU_QUOTA.exists() else ("max", "1")
    most = math.inf if limit == "max" else math.ceil(int(limit) / int(period))
    return max(1, min(len(set(cores)), most))
