"""Loads the MPI plugin: mark a test with `@pytest.mark.mpi(1, 2)` and ask for the fixture `comm`."""

import importlib
import logging
import os
import runpy
import sys
from pathlib import Path

import pytest

pytest_plugins = ["mpi_tools.pytest_mpi"]

UNDRAWN = Path(__file__).parent / "undrawn"


@pytest.fixture(autouse=True)
def logger_as_before():
    """What a test makes of the package's logger does not outlast it: tests of all modules share a process."""
    logger = logging.getLogger("eddies")
    handlers, propagate, level = list(logger.handlers), logger.propagate, logger.level
    yield
    logger.handlers, logger.propagate = handlers, propagate
    logger.setLevel(level)


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made but not drawn, here and in programs that are started: that is most of a report's time."""
    from eddies.report import figures
    monkeypatch.setattr(figures, "png", figures.png)  # what is set in the next line ends with the test
    runpy.run_path(str(UNDRAWN / "sitecustomize.py"))
    monkeypatch.setenv("PYTHONPATH", str(UNDRAWN), prepend=os.pathsep)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A function that writes a module of a user's, NAME and text, into tmp_path, where modules are found as long as the
    test lasts."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    written = []

    def write(name, text):
        path = tmp_path / f"{name}.py"
        path.write_text(text)
        importlib.invalidate_caches()
        written.append(name)
        return path

    yield write
    for name in written:
        sys.modules.pop(name, None)
