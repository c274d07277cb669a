"""Loads the MPI plugin: mark a test with `@pytest.mark.mpi(1, 2)` and ask for the fixture `comm`."""

import logging

import pytest

pytest_plugins = ["mpi_tools.pytest_mpi"]


@pytest.fixture(autouse=True)
def logger_as_before():
    """What a test makes of the package's logger does not outlast it: tests of all modules share a process."""
    logger = logging.getLogger("eddies")
    handlers, propagate, level = list(logger.handlers), logger.propagate, logger.level
    yield
    logger.handlers, logger.propagate = handlers, propagate
    logger.setLevel(level)
