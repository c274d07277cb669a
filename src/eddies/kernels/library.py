"""The compiled library: one shared object for each instruction set. The best one that the processor runs is loaded."""

import ctypes
import functools
import hashlib
import os
import sys
from pathlib import Path
from types import ModuleType

import numpy as np

from eddies.cores import threads
from eddies.errors import UserError

# Types of arguments and of members of structures.
INT, NUMBER, ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p
# The same as in setup.py. A processor that runs one of them also runs all before it.
INSTRUCTION_SETS = ("plain", "avx2", "avx512")
# Parameters of glibc's mallopt. Blocks of up to 32 MiB are taken from kept memory; larger ones are always mapped.
TRIM_THRESHOLD, TOP_PAD, MMAP_THRESHOLD = -1, -2, -3
KEPT = {MMAP_THRESHOLD: 2**25, TRIM_THRESHOLD: 2**30, TOP_PAD: 2**28}
REMEDY = ("install a C++ compiler (g++), then eddies again: `pip install --force-reinstall --no-deps .` in its sources "
          "or `bash mpi_tools/bootstrap.sh`")


class MissingLibraryError(UserError):
    """The compiled library is missing, does not load, or was not built from the sources beside it."""


@functools.cache
def library() -> ctypes.CDLL:
    """Return the library for this processor. Raises MissingLibraryError."""
    return load(in_use())


def instruction_sets() -> list[str]:
    """Return the instruction sets that the library was built for and that this processor runs, the best one last."""
    built = [name for name in INSTRUCTION_SETS if _path(name).exists()]
    if "plain" not in built:
        return []
    best = load("plain").best_instruction_set()
    return [name for name in built if INSTRUCTION_SETS.index(name) <= best]


def in_use() -> str:
    """Return the instruction set of the library that this process uses. Raises MissingLibraryError."""
    available = instruction_sets()
    if not available:
        raise MissingLibraryError(f"no compiled kernels in {_path('plain').parent}: {REMEDY}")
    return available[-1]


@functools.cache
def load(instruction_set: str) -> ctypes.CDLL:
    """Return the library for one instruction set.

    Raises MissingLibraryError if it does not load, or if it was not built from the sources beside it. In the second
    case its functions may take other arguments.
    """
    share_threads()
    try:
        loaded = ctypes.CDLL(str(_path(instruction_set)))
    except OSError as error:
        raise MissingLibraryError(f"the compiled kernels do not load ({error}): {REMEDY}") from error
    sources = sorted(_path("plain").parent.glob("*.?pp"))  # only a checkout has them
    built_from = getattr(loaded, "kernel_sources", None)
    if built_from is not None:
        built_from.restype = ctypes.c_char_p
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest().encode()
    if sources and (built_from is None or built_from() != digest):
        raise MissingLibraryError(f"the compiled kernels in {sources[0].parent} do not match the sources "
                                  "beside them: build them again with `python setup.py build_ext --inplace`")
    return loaded


@functools.cache
def import_pyfftw() -> ModuleType:
    """Import pyfftw without its interface to scipy.fftpack, which takes a third of the time until a command begins."""
    hidden = "scipy.fftpack" not in sys.modules
    if hidden:
        sys.modules["scipy.fftpack"] = None
    try:
        import pyfftw
    finally:
        if hidden:
            del sys.modules["scipy.fftpack"]
    return pyfftw


@functools.cache
def share_threads() -> None:
    """Make kernels, and torch if it is loaded later, use the OpenMP runtime of pyfftw's wheel.

    Otherwise the threads of two runtimes wait for each other on the same cores. A step of the direct simulation then
    takes twenty times as long.
    """
    maps = Path("/proc/self/maps")
    if threads() == 1 or not maps.exists():
        return
    pyfftw = import_pyfftw()
    runtimes = (line.split(maxsplit=5)[5] for line in maps.read_text().splitlines() if "/libgomp" in line)
    # The maps hold real paths, without links. Without a wheel, pyfftw uses the system's runtime, as all others do.
    of_wheel = Path(pyfftw.__file__).resolve().parents[1] / "pyfftw.libs"
    for path in dict.fromkeys(runtimes):
        if Path(path).parent == of_wheel:
            ctypes.CDLL(path, mode=ctypes.RTLD_GLOBAL)


def keep_freed_memory() -> None:
    """Keep freed memory in this process instead of returning it to the system.

    Otherwise new pages of memory take wall time: a sixth of it in a run of 32^3 particles with kriging.
    Does nothing if the user has set MALLOC_... variables, or with a C library other than glibc.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or any(name.startswith("MALLOC_") for name in os.environ):
        return
    for parameter, value in KEPT.items():
        mallopt(parameter, value)


def members(kind: type, names: str) -> list[tuple[str, type]]:
    """Return members of a ctypes structure that have one type; `names` are separated by spaces."""
    return [(name, kind) for name in names.split()]


def address(array: np.ndarray) -> int:
    """Return the address of the first element. The caller keeps the array until the library's function returns."""
    return array.ctypes.data


def require(array: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
    """Raise ValueError if an array has another shape or type, or is not contiguous."""
    if array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(f"{array.dtype} {array.shape}: contiguous {dtype} {shape} is needed")


def _path(instruction_set: str) -> Path:
    return Path(__file__).with_name(f"{instruction_set}.so")
