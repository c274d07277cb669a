"""Log lines of a parallel run, and the output streams of a command. Rank 0 logs all lines; other ranks log only
warnings, with their rank."""

import logging
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

from eddies.errors import UserError

OUTCOME = (logging.INFO + logging.WARNING) // 2  # level of the line about the final product
LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "outcome": OUTCOME, "warning": logging.WARNING}


def configure_logging(rank: int, level: str | None = None, stream: TextIO | None = None) -> None:
    """Send the lines of the logger "eddies" to `stream`, by default standard output.

    `level` is the level of rank 0: debug, info, outcome or warning. If it is None, the variable EDDIES_LOG gives the
    level; without the variable it is info. Raises UserError if EDDIES_LOG has another value.
    """
    name = level or os.environ.get("EDDIES_LOG", "info")
    if name not in LEVELS:
        raise UserError(f"EDDIES_LOG = {name}: must be one of {', '.join(LEVELS)}")
    handler = logging.StreamHandler(stream or sys.stdout)
    handler.setFormatter(_RankFormatter(rank))
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(LEVELS[name] if rank == 0 else max(LEVELS[name], logging.WARNING))


class Output:
    """Replaces standard output while a command runs.

    Characters that the encoding lacks are written as escapes such as "\\u2264". A failed write, as on a full disk, does
    not end the run. `end` reports the failure, unless the reader of a pipe, such as `head`, has closed the pipe.
    """

    def __init__(self) -> None:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # the stream is closed, and the next opened file would get its descriptor
                setattr(sys, name, open(os.devnull, "w"))
            if hasattr(getattr(sys, name), "reconfigure"):
                getattr(sys, name).reconfigure(errors="backslashreplace")
        self._stream, self._refusal, self._lost = sys.stdout, "", False
        sys.stdout = self  # type: ignore[assignment]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text. Raises nothing; `end` reports a failure later."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Flush the stream. Raises nothing; `end` reports a failure later."""
        self._try(self._stream.flush)

    def end(self) -> str | None:
        """Restore standard output. Returns the message about a failed write; None if no write failed, or if the reader
        closed the pipe."""
        self.flush()
        sys.stdout = self._stream
        if self._lost:
            os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())  # discards buffered text
        if not self._refusal:
            return None
        return f"cannot write to standard output: {self._refusal}; make room, or send it elsewhere"

    def _try(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as error:
            self._lost = True
            if not isinstance(error, BrokenPipeError):
                self._refusal = error.strerror or str(error)


def show_warnings() -> None:
    """Show each warning of a library in one line, without source code.

    The warning of mpi4py about the launcher is left out, because parallel/connection.py checks the launcher.
    """
    def show(message, category, filename, lineno, file=None, line=None) -> None:
        sys.stderr.write(f"eddies: warning: {' '.join(str(message).split())} ({Path(filename).name}, line {lineno})\n")

    warnings.showwarning = show
    warnings.filterwarnings("ignore", "suspicious MPI execution environment")


class _RankFormatter(logging.Formatter):
    """Puts "rank 3: " before messages of ranks other than 0, and the level before warnings and errors."""

    def __init__(self, rank: int) -> None:
        super().__init__()
        self._prefix = f"rank {rank}: " if rank else ""

    def format(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return f"{self._prefix}{level}{super().format(record)}"
