"""Without a compiler `pip install` ends with what to install, and what is there without kernels with the way to them;
with one it is seen by `mpi_tools/package_test.sh`."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

CHECKOUT = Path(__file__).parents[2]
SOURCES = ("setup.cfg", "setup.py", "pyproject.toml", "README.md", "LICENSE")


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
    return subprocess.run([sys.executable, *command], cwd="/", env={**os.environ, **variables}, capture_output=True,
                          text=True, timeout=400)


def test_without_a_compiler_the_last_line_of_the_build_names_the_package(copy):
    done = run("-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index",
               "--target", copy / "installed", copy, CXX="/nowhere/c++", CC="/nowhere/cc")
    said = [line.strip(" \u2502|") for line in (done.stdout + done.stderr).splitlines()]
    assert done.returncode != 0 and not (copy / "installed").exists()
    last = said[said.index("[end of output]") - 1]
    assert last.startswith("install g++ (Debian, Ubuntu: apt-get install g++;")


@pytest.mark.parametrize("command", [["run", "tiny"], ["check", "tiny"]])
def test_without_kernels_a_command_ends_with_the_way_to_them(copy, command):
    done = run("-m", "eddies", *command, PYTHONPATH=str(copy / "src"))
    line, = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith(f"eddies: error: no compiled kernels in {copy}")
    assert "install a C++ compiler (g++)" in line
