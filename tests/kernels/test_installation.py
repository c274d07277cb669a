"""`pip install` from a copy of the sources, with a compiler and without one."""

import os
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path

import pytest

from eddies.kernels import library
from eddies.kernels.library import in_use

CHECKOUT = Path(__file__).parents[2]
SOURCES = ("setup.cfg", "setup.py", "pyproject.toml", "README.md", "LICENSE")
SHOW = "import eddies.kernels.library as found; print(found.__file__); print(found.in_use())"


@pytest.fixture
def copy(tmp_path):
    """The sources alone, nothing that was built; to be compiled unoptimised, in a fifth of the time."""
    for name in SOURCES:
        shutil.copy(CHECKOUT / name, tmp_path)
    recipe = (CHECKOUT / "setup.py").read_text()
    assert recipe.count('"-O3"') == 1
    (tmp_path / "setup.py").write_text(recipe.replace('"-O3"', '"-O0"'))
    built = shutil.ignore_patterns("*.so", "*.egg-info", "__pycache__")
    shutil.copytree(CHECKOUT / "src", tmp_path / "src", ignore=built)
    return tmp_path


@pytest.fixture
def nearly_built(copy):
    """The same as a build leaves it that was stopped before the instruction set of this processor."""
    found = copy / f"build/lib.{sysconfig.get_platform()}-{sys.implementation.cache_tag}/eddies/kernels"
    found.mkdir(parents=True)
    for path in Path(library.__file__).parent.glob("*.so"):
        if path.stem != in_use():
            shutil.copyfile(path, found / path.name)  # newer than the sources
    return copy


def run(*command, **variables):
    # Outside of the checkout, whose package would be found first.
    done = subprocess.run([sys.executable, *command], cwd="/", env={**os.environ, **variables}, capture_output=True,
                          text=True, timeout=400)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("compiler", [True, False], ids=["with a compiler", "without one"])
def test_the_package_is_installed_and_runs(request, compiler):
    if compiler and shutil.which("g++") is None:
        pytest.skip("there is no compiler")
    # One instruction set is enough to see it compiled; a set-up has compiled all, optimised.
    copy = request.getfixturevalue("nearly_built" if compiler else "copy")
    target, variables = copy / "installed", {} if compiler else {"CC": "/nowhere/cc", "CXX": "/nowhere/c++"}
    said = run("-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "-v", "--target", target,
               copy, **variables)
    assert ("several times slower" in said) != compiler
    place, kernels = run("-c", SHOW, PYTHONPATH=str(target)).split()
    assert place.startswith(str(target)) and kernels == (in_use() if compiler else "none")
    told = run("-m", "eddies", "check", "tiny", PYTHONPATH=str(target))
    assert "tiny" in told and "time" in told
    assert (target / "eddies" / "scenes" / "tiny.toml").exists()
