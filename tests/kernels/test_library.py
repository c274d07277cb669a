"""The compiled library is found, or an error says how to get it; memory and threads of the process."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyfftw
import pytest

from eddies import errors
from eddies.errors import UserError
from eddies.kernels import library as module


@pytest.fixture
def elsewhere(tmp_path, monkeypatch):
    """An empty folder in which the library is looked for, and a function that clears what is cached."""
    def clear():
        for cached in (module.library, module.load):
            cached.cache_clear()

    monkeypatch.setattr(module, "__file__", str(tmp_path / "library.py"))
    clear()
    yield tmp_path, clear
    clear()


def test_a_missing_or_broken_library_is_an_error_that_names_the_compiler(elsewhere):
    (elsewhere[0] / "avx2.so").write_bytes(b"")
    assert module.instruction_sets() == []
    with pytest.raises(UserError, match=r"g\+\+"):
        module.library()
    (elsewhere[0] / "plain.so").write_bytes(b"no library")
    with pytest.raises(UserError, match=r"plain.so.*g\+\+"):
        module.library()


def test_a_library_of_other_sources_is_refused(elsewhere):
    folder, clear = elsewhere
    kernels = Path(errors.__file__).parent / "kernels"
    for file in (kernels / "plain.so", *kernels.glob("*.?pp")):
        shutil.copy(file, folder)
    assert module.library()
    clear()
    (folder / "pairs.cpp").write_text("")
    with pytest.raises(UserError, match="build_ext"):
        module.library()


def test_the_best_instruction_set_is_taken():
    available = module.instruction_sets()
    assert available[0] == "plain" and module.library() is module.load(available[-1])


def test_arrays_of_another_shape_type_or_layout_are_refused():
    module.require(np.zeros((2, 3)), (2, 3), np.float64)
    for array in (np.zeros((3, 2)), np.zeros((2, 3), np.float32), np.zeros((3, 2)).T, np.zeros((2, 6))[:, ::2]):
        with pytest.raises(ValueError, match="needed"):
            module.require(array, (2, 3), np.float64)


def printed(program, **environment):
    clean = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    return subprocess.run([sys.executable, "-c", program], env=clean | environment, check=True, capture_output=True,
                          text=True, timeout=60).stdout.strip()


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
def test_kernels_share_the_threads_of_the_transforms(threads, runtime):
    assert Path(printed(RUNTIME, OMP_NUM_THREADS=threads)).parent.name == runtime


PAGE_FAULTS = """
import resource
from eddies.kernels.library import keep_freed_memory
{keep}
for round in range(20):
    block = b"1" * 2**24
    del block
    if round == 0:
        before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="another C library")
def test_freed_memory_is_used_again_unless_the_user_has_set_malloc():
    def page_faults(keep, **environment):
        return int(printed(PAGE_FAULTS.format(keep=keep), **environment))

    kept = page_faults("keep_freed_memory()")
    assert kept < 100 < page_faults("pass", MALLOC_MMAP_THRESHOLD_="65536")
    assert page_faults("keep_freed_memory()", MALLOC_MMAP_THRESHOLD_="65536") > 100
