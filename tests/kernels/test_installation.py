"""Installation without a compiler, and commands without kernels, end with the remedy."""

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
    """A copy of the sources without anything that was built."""
    for name in SOURCES:
        shutil.copy(CHECKOUT / name, tmp_path)
    built = shutil.ignore_patterns("*.so", "*.egg-info", "__pycache__")
    shutil.copytree(CHECKOUT / "src", tmp_path / "src", ignore=built)
    return tmp_path


def run(*command, **variables):
    # Not in the checkout, whose package would be found first.
    return subprocess.run([sys.executable, *command], cwd="/", env={**os.environ, **variables}, capture_output=True,
                          text=True, timeout=400)


def test_without_a_compiler_the_build_names_the_package(copy):
    done = run("-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index",
               "--target", copy / "installed", copy, CXX="/nowhere/c++", CC="/nowhere/cc")
    lines = [line.strip(" \u2502|") for line in (done.stdout + done.stderr).splitlines()]
    assert done.returncode != 0 and not (copy / "installed").exists()
    assert "apt-get install g++" in lines[lines.index("[end of output]") - 1]


# The copy comes before an installed package.
COMMAND = "import sys; sys.path.insert(0, sys.argv.pop(1)); from eddies.cli import main; sys.exit(main())"


def test_without_kernels_a_command_ends_with_the_remedy(copy):
    done = run("-c", COMMAND, str(copy / "src"), "run", "tiny")
    line, = done.stderr.splitlines()
    assert done.returncode == 2 and line.startswith("eddies: error:") and str(copy) in line and "g++" in line
