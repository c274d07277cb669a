"""Loads the MPI plugin: mark a test with `@pytest.mark.mpi(1, 2)` and ask for the fixture `comm`."""

import importlib
import logging
import os
import pkgutil
import sys

import pytest

import eddies.report

pytest_plugins = ["mpi_tools.pytest_mpi"]


@pytest.fixture(autouse=True)
def fresh_logger():
    """Each test begins with the package's logger as imported: a command configures it, and module-scoped fixtures run
    commands before any function-scoped fixture is set up."""
    logger = logging.getLogger("eddies")
    logger.handlers, logger.propagate = [], True
    logger.setLevel(logging.NOTSET)


@pytest.fixture
def undrawn(monkeypatch):
    """Figures are made but not drawn: that is most of a report's time."""
    from eddies.report import figures
    monkeypatch.setattr(figures, "png", lambda figure: b"\x89PNG\r\n\x1a\n" + bytes(16))


@pytest.fixture
def no_figures(monkeypatch, undrawn):
    """Figures are not even made, which is most of the rest: for tests of a report's numbers and words."""
    from matplotlib.figure import Figure
    # All are imported first: one that is imported later would keep what it takes from another as it is now.
    modules = [importlib.import_module(found.name)
               for found in pkgutil.iter_modules(eddies.report.__path__, "eddies.report.")]
    for module in modules:
        for name, function in list(vars(module).items()):
            if getattr(function, "__annotations__", {}).get("return") in (Figure, "Figure"):
                monkeypatch.setattr(module, name, lambda *given, **named: None)


@pytest.fixture
def quick_solves(monkeypatch):
    """Three iterations in each solve for the resolved velocity, where it does not matter what is learned of it."""
    from eddies.particles.resolved_velocity import ResolvedVelocity
    monkeypatch.setattr(ResolvedVelocity, "iterations", 3)


@pytest.fixture
def quick_spectra(monkeypatch):
    """Three iterations for each spectrum of particles, where nobody looks at them."""
    from eddies.workflows.rollout import particle_measures
    monkeypatch.setattr(particle_measures, "MOST_ITERATIONS", 3)


@pytest.fixture
def own(tmp_path, monkeypatch):
    """A function that writes a module of a user's, NAME and text, into tmp_path, where modules are found as long as the
    test lasts."""
    monkeypatch.setattr(sys, "path", [*sys.path, str(tmp_path)])
    written = []

    def write(name, text):
        path, new = tmp_path / f"{name}.py", tmp_path / f"{name}-{os.getpid()}"
        new.write_text(text)
        new.replace(path)  # other ranks, which write the same, never read a part of it
        importlib.invalidate_caches()
        written.append(name)
        return path

    yield write
    for name in written:
        sys.modules.pop(name, None)
