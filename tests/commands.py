"""Commands and programs that tests run."""

import contextlib
import os
import signal
import subprocess
import sys
from pathlib import Path

from mpi_tools.launch import mpi_environment, mpirun_command

LAUNCHER = Path(__file__).parents[1] / "mpi_tools/launch.py"
#: A direct simulation of a few milliseconds a step that does not end by itself.
ENDLESS = ["-m", "eddies", "dns", "abc", "--set", "time.duration=1e6"]


def run_cli(*arguments):
    """The exit code of the command `eddies` with these arguments, in this process."""
    from eddies.cli import main
    return main([str(argument) for argument in arguments])


def refused(comm, capfd, command, *messages, code=2):
    """The command `eddies` ends with this code. Rank 0 prints one line with the messages, and the others print none."""
    assert run_cli(*command) == code
    errors = capfd.readouterr().err
    if comm.rank > 0:
        assert errors == ""
    else:
        assert errors.startswith("eddies: error: " if code == 2 else "eddies: ") and errors.count("\n") == 1, errors
        assert all(message in errors for message in messages), errors


def first_rank(comm, action, *arguments, **options):
    """Call an action on rank 0, after all ranks have done their work before it and before they go on."""
    comm.Barrier()
    if comm.rank == 0:
        action(*arguments, **options)
    comm.Barrier()


def set_all(changes):
    """The options that set these keys on the command line."""
    return [word for change in changes for word in ("--set", change)]


def python(*arguments, **options):
    """The ended Python program with these arguments."""
    # os.environ lacks what MPI has added to the environment of this process, with which mpirun would not start.
    given = {"stdin": subprocess.DEVNULL, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True,
             "timeout": 60, "env": dict(os.environ)}
    return subprocess.run([sys.executable, *map(str, arguments)], **given | options)


def on_ranks(ranks, *arguments):
    """The ended Python program with these arguments, on some ranks."""
    line = mpirun_command(ranks, [sys.executable, *map(str, arguments)])
    return subprocess.run(line, env=mpi_environment(ranks), stdin=subprocess.DEVNULL, capture_output=True, text=True,
                          timeout=60)


def launched(ranks, *arguments):
    """The arguments of Python that start a program on some ranks, as the job scripts do."""
    return [LAUNCHER, "-n", ranks, "--", sys.executable, *arguments]


@contextlib.contextmanager
def a_simulation(directory, ranks=1):
    """The simulation ENDLESS, running."""
    command = ["-u", *ENDLESS, "--output", directory]
    line = [sys.executable, *(launched(ranks, *command) if ranks > 1 else command)]
    # A shell's background job ignores the interrupt, and its children inherit that.
    job = subprocess.Popen(list(map(str, line)), stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE, text=True, start_new_session=True, env=dict(os.environ),
                           preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    try:
        while "dns: starts" not in (line := job.stdout.readline()):
            assert line, f"the job ended: {job.stderr.read()}"
        yield job
    finally:
        if job.poll() is None:
            job.kill()
        job.communicate()
