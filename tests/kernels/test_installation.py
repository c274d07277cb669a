"""`pip install` from a copy of the sources without a compiler; with one it is seen by `mpi_tools/package_test.sh`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
SOURCES = ("setup.cfg", "setup.py", "pyproject.toml", "README.md", "LICENSE")
SHOW = "import eddies.kernels.library as found; print(found.__file__); print(found.in_use())"


@pytest.fixture
def copy(tmp_path):
    """The sources alone, nothing that was built."""
    for name in SOURCES:
        shutil.copy(CHECKOUT / name, tmp_path)
    built = shutil.ignore_patterns("*.so", "*.egg-info", "__pycache__")
    shutil.copytree(CHECKOUT / "src", tmp_path / "src", ignore=built)
    return tmp_path


def run(*command, **variables):
    # Outside of the checkout, whose package would be found first.
    done = subprocess.run([sys.executable, *command], cwd="/", env={**os.environ, **variables}, capture_output=True,
                          text=True, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


def test_without_a_compiler_the_package_is_installed_and_runs(copy):
    target = copy / "installed"
    said = run("-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "-v", "--target", target,
               copy, CC="/nowhere/cc", CXX="/nowhere/c++")
    assert "several times slower" in said
    place, kernels = run("-c", SHOW, PYTHONPATH=str(target)).split()
    assert place.startswith(str(target)) and kernels == "none"
    told = run("-m", "eddies", "check", "tiny", PYTHONPATH=str(target))
    assert "tiny" in told and "time" in told
    for kind in ("scenes", "weights"):
        assert any((target / "eddies" / kind).glob("tiny.*"))
