"""Log lines of a parallel run. Rank 0 logs all lines; other ranks log only warnings, with their rank."""

import logging
import os
import sys
import warnings
from pathlib import Path
from typing import TextIO

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
    handler.handleError = lambda record: None  # a run goes on if a line cannot be written, as to a closed pipe
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(LEVELS[name] if rank == 0 else max(LEVELS[name], logging.WARNING))


def show_warnings() -> None:
    """Show each warning of a library in one line, without source code."""
    def show(message, category, filename, lineno, file=None, line=None) -> None:
        sys.stderr.write(f"eddies: warning: {' '.join(str(message).split())} ({Path(filename).name}, line {lineno})\n")

    warnings.showwarning = show


class _RankFormatter(logging.Formatter):
    """Puts "rank 3: " before messages of ranks other than 0, and the level before warnings and errors."""

    def __init__(self, rank: int) -> None:
        super().__init__()
        self._prefix = f"rank {rank}: " if rank else ""

    def format(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return f"{self._prefix}{level}{super().format(record)}"
