"""The compiled library: one shared object for each instruction set, of which the processor gets its best."""

from __future__ import annotations

import ctypes
import functools
import hashlib
from pathlib import Path

from eddies.cores import threads
from eddies.errors import UserError

# As setup.py has them; a processor that runs one runs those before it.
INSTRUCTION_SETS = ("plain", "avx2", "avx512")
REMEDY = ("install a C++ compiler (g++), then eddies anew: `pip install --force-reinstall --no-deps .` in its sources, "
          "or `bash mpi_tools/bootstrap.sh`")


class MissingLibraryError(UserError):
    """The compiled library is not there, does not load, or is not of the sources beside it."""


@functools.cache
def library() -> ctypes.CDLL:
    """The library for this processor. Raises MissingLibraryError where there is none."""
    return load(in_use())


def instruction_sets() -> list[str]:
    """Those that the library is built for and this processor runs, the best one last."""
    built = [name for name in INSTRUCTION_SETS if _path(name).exists()]
    if "plain" not in built:
        return []
    best = load("plain").best_instruction_set()
    return [name for name in built if INSTRUCTION_SETS.index(name) <= best]


def in_use() -> str:
    """The instruction set of the library that serves this process. Raises MissingLibraryError where there is none."""
    found = instruction_sets()
    if not found:
        raise MissingLibraryError(f"no compiled kernels in {_path('plain').parent}: {REMEDY}")
    return found[-1]


@functools.cache
def load(instruction_set: str) -> ctypes.CDLL:
    """The library for an instruction set that it is built for. Raises MissingLibraryError where it does not load, and
    where it was built from other sources than lie beside it, as they do in a checkout: what it is called with may have
    changed."""
    share_threads()
    try:
        found = ctypes.CDLL(str(_path(instruction_set)))
    except OSError as error:
        raise MissingLibraryError(f"the compiled kernels do not load ({error}): {REMEDY}") from error
    sources = sorted(_path("plain").parent.glob("*.?pp"))
    built_from = getattr(found, "kernel_sources", None)
    if built_from is not None:
        built_from.restype = ctypes.c_char_p
    told = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest().encode()
    if sources and (built_from is None or built_from() != told):
        raise MissingLibraryError(f"the compiled kernels in {sources[0].parent} are of other sources than lie there: "
                                  "build them anew with `python setup.py build_ext --inplace`")
    return found


@functools.cache
def share_threads() -> None:
    """Let kernels, and torch if it is loaded later, use the OpenMP runtime that pyfftw's wheel brings along. The
    threads of two runtimes would wait for each other, spinning on the same cores: a step of the direct simulation took
    twenty times as long."""
    maps = Path("/proc/self/maps")
    if threads() == 1 or not maps.exists():
        return
    import pyfftw
    places = (line.split(maxsplit=5)[5] for line in maps.read_text().splitlines() if "/libgomp" in line)
    # As maps have it, also where the way to it is a link; elsewhere it has that of the system, as all do.
    brought = Path(pyfftw.__file__).resolve().parents[1] / "pyfftw.libs"
    for place in dict.fromkeys(places):
        if Path(place).parent == brought:
            ctypes.CDLL(place, mode=ctypes.RTLD_GLOBAL)


def _path(instruction_set: str) -> Path:
    return Path(__file__).with_name(f"{instruction_set}.so")
