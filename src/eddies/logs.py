"""Log lines of a parallel run: rank 0 reports, the other ranks only warn and say which rank they are. And the streams
on which all that a command says goes out."""

import logging
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

from eddies.scene.scene import SceneError

OUTCOME = (logging.INFO + logging.WARNING) // 2  # of the line in which a command says what it has made, and where
LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "outcome": OUTCOME, "warning": logging.WARNING}


def configure_logging(rank: int, level: str | None = None) -> None:
    """Send the logger "eddies" to standard output; `level` = debug, info, outcome or warning is rank 0's, by default
    that of the variable EDDIES_LOG.

    Raises:
        SceneError: EDDIES_LOG is none of these.
    """
    name = level or os.environ.get("EDDIES_LOG", "info")
    if name not in LEVELS:
        raise SceneError(f"EDDIES_LOG = {name}: must be one of {', '.join(LEVELS)}")
    handler = logging.StreamHandler(sys.stdout)
    handler.setFormatter(_RankFormatter(rank))
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(LEVELS[name] if rank == 0 else max(LEVELS[name], logging.WARNING))


class Output:
    """Standard output of a command: it takes any text, what its encoding lacks as "\\u2264", and a line that cannot be
    written, as on a full disk, is no reason to end a run, but for its end to tell. Making one puts it in place."""

    def __init__(self) -> None:
        for name in ("stdout", "stderr"):
            if getattr(sys, name) is None:  # closed: the next file that is opened must not take its place
                setattr(sys, name, open(os.devnull, "w"))
            if hasattr(getattr(sys, name), "reconfigure"):
                getattr(sys, name).reconfigure(errors="backslashreplace")
        self._stream, self._refusal = sys.stdout, ""
        sys.stdout = self  # type: ignore[assignment]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        """Write a text; an error is kept for `end`."""
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        """Write out what is held back; an error is kept for `end`."""
        self._try(self._stream.flush)

    def end(self) -> str | None:
        """Put the stream back; what kept text from being written, in words, or None."""
        self.flush()
        sys.stdout = self._stream
        if not self._refusal:
            return None
        os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())  # what is still held back is lost
        return f"cannot write to standard output: {self._refusal}; make room, or send it elsewhere"

    def _try(self, action: Callable[[], Any]) -> None:
        try:
            action()
        except OSError as error:
            self._refusal = error.strerror or str(error)


def show_warnings() -> None:
    """Show warnings of libraries in a line each, without the source of who warns; not what mpi4py suspects of the
    launcher, as parallel/connection.py knows it."""
    def show(message, category, filename, lineno, file=None, line=None) -> None:
        sys.stderr.write(f"eddies: warning: {' '.join(str(message).split())} ({Path(filename).name}, line {lineno})\n")

    warnings.showwarning = show
    warnings.filterwarnings("ignore", "suspicious MPI execution environment")


class _RankFormatter(logging.Formatter):
    """Rank 0's messages as they are, "rank 3: " before those of others; warnings and errors are so named."""

    def __init__(self, rank: int) -> None:
        super().__init__()
        self._prefix = f"rank {rank}: " if rank else ""

    def format(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return f"{self._prefix}{level}{super().format(record)}"
