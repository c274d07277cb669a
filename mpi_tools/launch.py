"""Start a command on this machine's cores under `mpirun`, with the environment that it needs.

SIGTERM, SIGUSR1, SIGINT and SIGHUP, unless they are ignored, reach the ranks as SIGUSR1, so that the ranks can end
their work properly. A second signal other than SIGUSR1 ends the job at once.

    python mpi_tools/launch.py [-n RANKS] -- COMMAND...

By default RANKS is the number of cores divided by OMP_NUM_THREADS, or EDDIES_RANKS if that is smaller. Environment
variables that are already set do not change.
"""

import argparse
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "src"))  # of this checkout, if eddies is not installed yet
from eddies.cores import check_threads, default_to_one_thread, is_positive, local_cores, threads  # noqa: E402

# RULE is the line above and below a notice of mpirun. NOTICES are beginnings of notices about a non-zero exit code.
# EXPLAINED are the exit codes for bad input, stopped and interrupted, whose reason the ranks have printed themselves.
RULE = b"-" * 74
NOTICES = (b"Primary job  terminated normally", b"mpirun detected that one or more processes exited with non-zero",
           b"prterun detected that one or more processes exited with non-zero")
EXPLAINED = (2, 75, 130)


def default_ranks() -> int:
    """Return the number of cores divided by OMP_NUM_THREADS, or EDDIES_RANKS if that is smaller.

    Raises ValueError if one of the two variables has a wrong value.
    """
    check_threads()
    most, asked = max(local_cores() // threads(), 1), os.environ.get("EDDIES_RANKS", "").strip()
    return min(most, positive("EDDIES_RANKS", asked)) if asked else most


def positive(name: str, text: str) -> int:
    """Return the number in the `text` of the variable or option `name`.

    Raises ValueError if the text is not a whole number of at least 1.
    """
    if not is_positive(text):
        raise ValueError(f'{name} = "{text}": must be a whole number of at least 1')
    return int(text)


def mpi_environment(ranks: int) -> dict[str, str]:
    """Return this process's environment, extended by the variables that `ranks` ranks on this machine need."""
    needed = {
        # Two jobs on one machine would both be bound to its first cores.
        "OMPI_MCA_hwloc_base_binding_policy": "none",
    }
    if os.geteuid() == 0:
        # Open MPI refuses to start as root, the usual user of a container, unless both variables permit it.
        needed |= {"OMPI_ALLOW_RUN_AS_ROOT": "1", "OMPI_ALLOW_RUN_AS_ROOT_CONFIRM": "1"}
    if ranks > local_cores():
        # Permit more ranks than cores (Open MPI 4, then 5); a waiting rank leaves its core to another.
        needed |= {"OMPI_MCA_rmaps_base_oversubscribe": "1",
                   "PRTE_MCA_rmaps_default_mapping_policy": ":oversubscribe",
                   "OMPI_MCA_mpi_yield_when_idle": "1"}
    environment = needed | dict(os.environ)
    default_to_one_thread(environment)
    return environment


def mpirun_command(ranks: int, command: list[str]) -> list[str]:
    """Return the command line of `mpirun` that starts `command` on `ranks` ranks.

    Raises FileNotFoundError if there is no mpirun.
    """
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        raise FileNotFoundError("no mpirun on the PATH: run mpi_tools/bootstrap.sh, or load an MPI module")
    return [mpirun, "-n", str(ranks), *command]


class ErrorOutput:
    """Filter for the error output of a job. It drops notices of mpirun about errors that the ranks have explained."""

    def __init__(self) -> None:
        self._line, self._frame, self._held, self._said, self._midway = b"", [], b"", False, False

    def pass_on(self, content: bytes) -> bytes:
        """Return the bytes to write now. Notices, and lines that may begin a notice, are held back."""
        *lines, self._line = (self._line + content).split(b"\n")
        passed = b"".join(self._pass_line(line + b"\n") for line in lines)
        if self._line and not self._frame and not RULE.startswith(self._line):
            passed, self._line, self._midway, self._said = passed + self._line, b"", True, True
        return passed

    def rest(self) -> bytes:
        """Return what is still held back when the job has ended.

        Notices are left out if the ranks wrote something else and an exit code in the notices is in EXPLAINED.
        """
        explained = self._said and any(f"Exit code:    {code}\n".encode() in self._held for code in EXPLAINED)
        return (b"" if explained else self._held) + b"".join(self._frame) + self._line

    def _pass_line(self, line: bytes) -> bytes:
        if self._midway:  # the end of a line whose beginning was already written
            self._midway = False
            return line
        self._frame.append(line)
        first, *others = self._frame
        if len(others) == 1 and line.rstrip() == RULE:  # `first` ends another notice, and `line` begins one
            self._frame, self._said = [line], True
            return first
        if first.rstrip() != RULE or others and not others[0].startswith(NOTICES):
            passed, self._frame, self._said = b"".join(self._frame), [], True
            return passed
        if others[1:] and line.rstrip() == RULE:
            self._held, self._frame = self._held + b"".join(self._frame), []
        return b""


def pass_errors_on(job: subprocess.Popen) -> None:
    """Copy a job's error output to that of this process, until it ends."""
    output = ErrorOutput()
    with os.fdopen(os.dup(sys.stderr.fileno()), "wb", buffering=0) as errors:
        def write(content: bytes) -> None:
            with contextlib.suppress(OSError):  # a failing write must not block the job
                errors.write(content)

        while content := os.read(job.stderr.fileno(), 2**16):
            write(output.pass_on(content))
        write(output.rest())


def run_job(line: list[str], environment: dict[str, str]) -> int:
    """Run mpirun to its end. Return its exit code, or 128 plus the number of the signal that ended it.

    The first signal reaches mpirun as SIGUSR1, which mpirun only forwards to its ranks. After a SIGTERM it would soon
    kill them and return a code of its own.
    """
    terminations: list[int] = []

    def forward(number: int, frame: object) -> None:
        terminations.extend([number] if number != signal.SIGUSR1 else [])
        job.send_signal(signal.SIGTERM if len(terminations) > 1 else signal.SIGUSR1)

    signals = {number for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGINT)
               if signal.getsignal(number) != signal.SIG_IGN}
    # Signals are blocked until there is a job to forward them to.
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    job = subprocess.Popen(line, env=environment, stderr=subprocess.PIPE,
                           preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_UNBLOCK, signals))
    for number in signals:
        signal.signal(number, forward)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
    errors = threading.Thread(target=pass_errors_on, args=(job,), daemon=True)
    errors.start()
    code = job.wait()
    errors.join()
    # The keyboard also interrupts mpirun, which ends the ranks by SIGTERM.
    if signal.SIGINT in terminations and code not in (0, *EXPLAINED):
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    return code if code >= 0 else 128 - code


def main() -> None:
    """Run the command and exit with its code."""
    parser = argparse.ArgumentParser(description="Start a command on this machine's cores under mpirun.")
    parser.add_argument("-n", dest="ranks", help="number of ranks (default: as many as fit the cores)")
    parser.add_argument("command", nargs="+")
    given = parser.parse_args()
    try:
        ranks = default_ranks() if given.ranks is None else positive("-n", given.ranks)
        line = mpirun_command(ranks, given.command)
    except (ValueError, FileNotFoundError) as error:
        parser.error(str(error))
    sys.exit(run_job(line, mpi_environment(ranks)))


if __name__ == "__main__":
    main()
