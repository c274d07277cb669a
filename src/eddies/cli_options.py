"""The command line: sub-commands with options and examples."""

from __future__ import annotations

import argparse
import contextlib
import math
import os
from pathlib import Path

import eddies
from eddies.errors import UserError
from eddies.pipeline import STAGES

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
        add_job_options(command, "run directory (default: runs/NAME)")
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


class OptionError(UserError):
    """An option of the command line is invalid."""


def directory(text: str) -> Path:
    """Return the path of a directory that the command line names; the directory need not exist."""
    if not text:
        raise OptionError("an empty text is not a directory; give a name, or . for the working directory")
    try:
        Path(text).exists()
    except OSError as error:
        raise OptionError(f"{text[:60]}...: cannot be used as a directory: {error.strerror}; choose another") from None
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


def add_job_options(parser: argparse.ArgumentParser, output: str) -> None:
    """Add the options of long commands: run directory, replacement of older work, and limits of wall time. `output` is
    the help of the option --output."""
    parser.add_argument("--output", type=directory, metavar="DIR", help=output)
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
