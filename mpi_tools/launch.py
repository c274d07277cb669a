"""Start a command on this machine's cores under `mpirun`, with the environment that it needs there.

SIGTERM, SIGUSR1, SIGINT and, unless it is ignored, SIGHUP reach the ranks as SIGUSR1, so that they can end in order; a
second one, but for SIGUSR1, ends the job at once.

    python mpi_tools/launch.py [-n RANKS] -- COMMAND...

RANKS is the number of cores over OMP_NUM_THREADS, or EDDIES_RANKS where that is smaller. Variables that are set already
stay as they are.
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

sys.path.append(str(Path(__file__).parents[1] / "src"))  # of this checkout, where no eddies is installed yet
from eddies.cores import check_threads, default_to_one_thread, is_positive, local_cores, threads  # noqa: E402

# How mpirun frames its notices, how those begin that tell of a rank that has not ended with 0, and the exit codes of
# which the ranks have said why: bad input, stopped, interrupted.
RULE = b"-" * 74
NOTICES = (b"Primary job  terminated normally", b"mpirun detected that one or more processes exited with non-zero",
           b"prterun detected that one or more processes exited with non-zero")
EXPLAINED = (2, 75, 130)


def default_ranks() -> int:
    """As many as there are cores for OMP_NUM_THREADS threads each, or EDDIES_RANKS where that asks for fewer.

    Raises ValueError if one of these is no number of at least 1.
    """
    check_threads()
    most, asked = max(local_cores() // threads(), 1), os.environ.get("EDDIES_RANKS", "").strip()
    return min(most, positive("EDDIES_RANKS", asked)) if asked else most


def positive(name: str, text: str) -> int:
    """The number of at least 1 that a text is, given by this name; ValueError where it is none."""
    if not is_positive(text):
        raise ValueError(f'{name} = "{text}": must be a whole number of at least 1')
    return int(text)


def mpi_environment(ranks: int) -> dict[str, str]:
    """The caller's environment and what `ranks` ranks on this machine need beyond it."""
    needed = {
        # Two jobs on one machine would both be bound to its first cores.
        "OMPI_MCA_hwloc_base_binding_policy": "none",
    }
    if os.geteuid() == 0:
        # Open MPI refuses to start as root, the usual user of a container, unless both say that it is meant.
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
    """The `mpirun` line that starts `command` on `ranks` ranks; FileNotFoundError without an mpirun."""
    mpirun = shutil.which("mpirun")
    if mpirun is None:
        raise FileNotFoundError("no mpirun on the PATH: run mpi_tools/bootstrap.sh, or load an MPI module")
    return [mpirun, "-n", str(ranks), *command]


class ErrorOutput:
    """The error output of a job without the notices of mpirun that repeat what the ranks have said themselves."""

    def __init__(self) -> None:
        self._line, self._frame, self._held, self._said, self._midway = b"", [], b"", False, False

    def pass_on(self, content: bytes) -> bytes:
        """What of the next bytes is to be written now: all but a line that may frame a notice, and notices."""
        *lines, self._line = (self._line + content).split(b"\n")
        passed = b"".join(self._pass_line(line + b"\n") for line in lines)
        if self._line and not self._frame and not RULE.startswith(self._line):
            passed, self._line, self._midway, self._said = passed + self._line, b"", True, True
        return passed

    def rest(self) -> bytes:
        """What is left at the end: notices too, if the ranks have said nothing or their exit code tells of a fault."""
        explained = self._said and any(f"Exit code:    {code}\n".encode() in self._held for code in EXPLAINED)
        return (b"" if explained else self._held) + b"".join(self._frame) + self._line

    def _pass_line(self, line: bytes) -> bytes:
        if self._midway:  # the end of a line whose beginning has been passed on
            self._midway = False
            return line
        self._frame.append(line)
        first, *others = self._frame
        if len(others) == 1 and line.rstrip() == RULE:  # the end of another frame, and the begin of this
            self._frame, self._said = [line], True
            return first
        if first.rstrip() != RULE or others and not others[0].startswith(NOTICES):
            passed, self._frame, self._said = b"".join(self._frame), [], True
            return passed
        if others[1:] and line.rstrip() == RULE:
            self._held, self._frame = self._held + b"".join(self._frame), []
        return b""


def pass_errors_on(job: subprocess.Popen) -> None:
    """Write a job's error output to this one's, until it ends."""
    output = ErrorOutput()
    with os.fdopen(os.dup(sys.stderr.fileno()), "wb", buffering=0) as errors:
        def write(content: bytes) -> None:
            with contextlib.suppress(OSError):  # what cannot be written must not keep the job waiting
                errors.write(content)

        while content := os.read(job.stderr.fileno(), 2**16):
            write(output.pass_on(content))
        write(output.rest())


def run_job(line: list[str], environment: dict[str, str]) -> int:
    """Run mpirun to its end; its exit code, or 128 and the number of the signal that ended it.

    mpirun kills its ranks soon after a SIGTERM and returns a code of its own; SIGUSR1 it hands on, and no more.
    """
    terminations: list[int] = []

    def hand_on(number: int, frame: object) -> None:
        terminations.extend([number] if number != signal.SIGUSR1 else [])
        job.send_signal(signal.SIGTERM if len(terminations) > 1 else signal.SIGUSR1)

    signals = {number for number in (signal.SIGTERM, signal.SIGUSR1, signal.SIGHUP, signal.SIGINT)
               if signal.getsignal(number) != signal.SIG_IGN}
    # Held back until there is a job to hand them on to.
    signal.pthread_sigmask(signal.SIG_BLOCK, signals)
    job = subprocess.Popen(line, env=environment, stderr=subprocess.PIPE,
                           preexec_fn=lambda: signal.pthread_sigmask(signal.SIG_UNBLOCK, signals))
    for number in signals:
        signal.signal(number, hand_on)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, signals)
    errors = threading.Thread(target=pass_errors_on, args=(job,), daemon=True)
    errors.start()
    code = job.wait()
    errors.join()
    # The keyboard interrupts mpirun as well, which ends the ranks by SIGTERM.
    if signal.SIGINT in terminations and code not in (0, *EXPLAINED):
        print("interrupted", file=sys.stderr)
        return 128 + signal.SIGINT
    return code if code >= 0 else 128 - code


def main() -> None:
    """Run the command and end with its exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-n", dest="ranks", help="number of ranks (default: one for each core)")
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
