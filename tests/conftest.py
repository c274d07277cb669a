"""Loads the MPI plugin: mark a test with `@pytest.mark.mpi(1, 2)` and ask for the fixture `comm`."""

import importlib
import logging
import os
import sys
from types import SimpleNamespace

import pytest

pytest_plugins = ["mpi_tools.pytest_mpi"]


@pytest.fixture(autouse=True, scope="session")
def no_waiting_for_the_disk():
    """Products are not forced to the disk, which takes ten milliseconds for each."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(autouse=True)
def fresh_logger():
    """Reset the logger of the package before each test, because commands configure it."""
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [], True
    logger.setLevel(logging.NOTSET)


@pytest.fixture
def undrawn(monkeypatch):
    """Make figures but do not draw them, which takes most of the time of a report."""
    from eddies.report import figures
    monkeypatch.setattr(figures, "png", lambda figure: b"\x89PNG\r\n\x1a\n" + bytes(16))


@pytest.fixture
def no_figures(monkeypatch, undrawn):
    """Do not even make figures, for tests of the numbers and words of a report."""
    from tests.left_out import leave_out_figures
    leave_out_figures(monkeypatch)


@pytest.fixture
def quick_solves(monkeypatch):
    """Three iterations in each solve for the resolved velocity, for tests in which its accuracy does not matter."""
    from eddies.particles.resolved_velocity import ResolvedVelocity
    monkeypatch.setattr(ResolvedVelocity, "iterations", 3)


@pytest.fixture
def quick_spectra(monkeypatch):
    """Three iterations for each spectrum of particles, for tests in which its accuracy does not matter."""
    from eddies.workflows.rollout import particle_measures
    monkeypatch.setattr(particle_measures, "MOST_ITERATIONS", 3)


@pytest.fixture
def unmeasured(monkeypatch):
    """Do not measure a rollout at its end, for tests of the rollouts themselves. A report measures it then."""
    from eddies.workflows import simulate
    monkeypatch.setattr(simulate, "measure", SimpleNamespace(run=lambda directory, comm: None))


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A function that writes a module of a user into tmp_path, which is on the import path during the test."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    written = []

    def write(name, text):
        path, new = tmp_path / f"{name}.py", tmp_path / f"{name}-{os.getpid()}"
        new.write_text(text)
        new.replace(path)  # other ranks write the same file, and must not read a part of it
        importlib.invalidate_caches()
        written.append(name)
        return path

    yield write
    for name in written:
        sys.modules.pop(name, None)
