"""Log lines of a parallel run: rank 0 reports, the other ranks only warn and say which rank they are."""

import logging
import os
import sys

from eddies.scene.scene import SceneError

LEVELS = {"debug": logging.DEBUG, "info": logging.INFO, "warning": logging.WARNING}


def configure_logging(rank: int) -> None:
    """Send the logger "eddies" to standard output; `EDDIES_LOG` = debug, info or warning sets rank 0's level.

    Raises:
        SceneError: EDDIES_LOG is none of these.
    """
    name = os.environ.get("EDDIES_LOG", "info")
    if name not in LEVELS:
        raise SceneError(f"EDDIES_LOG = {name}: must be one of {', '.join(LEVELS)}")
    handler = _Output(sys.stdout)
    handler.setFormatter(_RankFormatter(rank))
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(LEVELS[name] if rank == 0 else max(LEVELS[name], logging.WARNING))


class _Output(logging.StreamHandler):
    """Drops a line that cannot be written, as on a full disk: what else needs that disk tells its lack itself."""

    def handleError(self, record: logging.LogRecord) -> None:
        if not isinstance(sys.exc_info()[1], OSError):
            super().handleError(record)


class _RankFormatter(logging.Formatter):
    """Rank 0's messages as they are, "rank 3: " before those of others; warnings and errors are so named."""

    def __init__(self, rank: int) -> None:
        super().__init__()
        self._prefix = f"rank {rank}: " if rank else ""

    def format(self, record: logging.LogRecord) -> str:
        level = f"{record.levelname.lower()}: " if record.levelno >= logging.WARNING else ""
        return f"{self._prefix}{level}{super().format(record)}"
