"""Start a command on this machine's cores under `mpirun`, with the environment that it needs there.

    python mpi_tools/launch.py [-n RANKS] -- COMMAND...

RANKS is the number of cores, or EDDIES_RANKS where that is smaller. Variables that are set already stay as
they are.
"""

import argparse
import math
import os
import shutil
import sys
from pathlib import Path

CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def local_cores() -> int:
    """Physical cores that this process may use: affinity and container quota count, hyper-threads do not."""
    cores = set()
    for cpu in os.sched_getaffinity(0):
        siblings = Path(f"/sys/devices/system/cpu/cpu{cpu}/topology/thread_siblings_list")
        cores.add(siblings.read_text() if siblings.exists() else str(cpu))
    limit, period = (CPU_QUOTA.read_text().split() if CPU_QUOTA.exists() else ("max", "1"))
    return len(cores) if limit == "max" else max(1, min(len(cores), math.ceil(int(limit) / int(period))))


def default_ranks() -> int:
    """All cores, or EDDIES_RANKS where that asks for fewer; ValueError if it is no positive integer."""
    asked = os.environ.get("EDDIES_RANKS") or str(local_cores())
    if not asked.isdigit() or int(asked) < 1:
        raise ValueError(f"EDDIES_RANKS = {asked!r}: a positive number of ranks is expected")
    return min(local_cores(), int(asked))


def mpi_environment(ranks: int) -> dict[str, str]:
    """The caller's environment and what `ranks` ranks on this machine need beyond it."""
    needed = {
        # One thread a rank: torch, OpenBLAS and MKL would start a thread on every core, in every rank.
        "OMP_NUM_THREADS": "1",
        # Two jobs on one machine would both be bound to its first cores.
        "OMPI_MCA_hwloc_base_binding_policy": "none",
        # Seconds from SIGTERM to SIGKILL; mpirun waits twice this when a rank fails.
        "OMPI_MCA_odls_base_sigkill_timeout": "3",
    }
    if os.geteuid() == 0:
        # Open MPI refuses to start as root, the usual user of a container, unless both say that it is meant.
        needed |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    if ranks > local_cores():
        # Permit more ranks than cores (Open MPI 4, then 5); a waiting rank leaves its core to another.
        needed |= {"OMPI_MCA_rmaps_base_oversubscribe": "1",
                   "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
                   "OMPI_MCA_mpi_yield_when_idle": "1"}
    return needed | dict(os.environ)


def mpirun_command(ranks: int, command: list[str]) -> list[str]:
    """The `mpirun` line that starts `command` on `ranks` ranks; FileNotFoundError without an mpirun."""
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        raise FileNotFoundError("no mpirun on the PATH: run mpi_tools/bootstrap.sh, or load an MPI module")
    return [mpirun, "-n", str(ranks), *command]


def main() -> None:
    """Become mpirun, so that its signals and its exit code are the caller's."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", dest="ranks", type=int, help="number of ranks (default: one for each core)")
    parser.add_argument("command", nargs="+")
    given = parser.parse_args()
    try:
        ranks = given.ranks or default_ranks()
        line = mpirun_command(ranks, given.command)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    sys.stdout.flush()
    os.execve(line[0], line, mpi_environment(ranks))


if __name__ == "__main__":
    main()
