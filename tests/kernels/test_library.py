"""The library is found, or the way to it told."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pyfftw
import pytest

from eddies import errors
from eddies.errors import UserError
from eddies.kernels import library as module


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """No library where it is looked for."""
    monkeypatch.setattr(module, "__file__", str(tmp_path / "library.py"))
    for cached in (module.library, module.load):
        cached.cache_clear()
    yield tmp_path
    for cached in (module.library, module.load):
        cached.cache_clear()


def test_without_the_plain_one_none_is_trusted_to_run_and_a_line_tells_the_way_to_it(elsewhere):
    (elsewhere / "avx2.so").write_bytes(b"")
    assert module.instruction_sets() == []
    for ask in (module.library, module.in_use):
        with pytest.raises(UserError, match=r"no compiled kernels in .*: install .* \(g\+\+\)") as raised:
            ask()
        assert "\n" not in str(raised.value)


def test_one_that_does_not_load_is_told(elsewhere):
    (elsewhere / "plain.so").write_bytes(b"no library")
    with pytest.raises(UserError, match=r"do not load \(.*plain.so: .*\): install .* \(g\+\+\)"):
        module.library()


def test_one_of_other_sources_than_lie_beside_it_is_refused(elsewhere):
    kernels = Path(errors.__file__).parent / "kernels"
    shutil.copy(kernels / "plain.so", elsewhere)
    for source in kernels.glob("*.?pp"):
        shutil.copy(source, elsewhere)
    assert module.library()
    for cached in (module.library, module.load):
        cached.cache_clear()
    (elsewhere / "pairs.cpp").write_text("")
    with pytest.raises(UserError, match="of other sources than lie there: build them anew"):
        module.library()


def test_the_best_that_the_processor_runs_is_taken():
    found = module.instruction_sets()
    assert found[0] == "plain" and module.library() is module.load(found[-1])


RUNTIME = """
import ctypes
from eddies.kernels.library import library
library()
try:
    place = ctypes.cast(ctypes.CDLL(None).GOMP_parallel, ctypes.c_void_p).value
except AttributeError:
    place = None
for line in open("/proc/self/maps"):
    first, last = (int(end, 16) for end in line.split()[0].split("-"))
    if place and first <= place < last:
        print(line.split()[-1])
"""


@pytest.mark.skipif(not (Path(pyfftw.__file__).parents[1] / "pyfftw.libs").exists(), reason="pyfftw brings no OpenMP")
@pytest.mark.parametrize("threads, runtime", [("1", ""), ("2", "pyfftw.libs")])
def test_kernels_take_the_threads_of_the_transforms(threads, runtime):
    found = subprocess.run([sys.executable, "-c", RUNTIME], timeout=60, check=True, capture_output=True, text=True,
                           env={**os.environ, "OMP_NUM_THREADS": threads}).stdout.strip()
    assert Path(found).parent.name == runtime
