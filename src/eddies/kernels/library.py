"""The compiled library: one shared object for each instruction set, of which the processor gets its best."""

from __future__ import annotations

import ctypes
import functools
import logging
from pathlib import Path

from eddies.parallel.node import threads

# As setup.py has them; a processor that runs one runs those before it.
INSTRUCTION_SETS = ("plain", "avx2", "avx512")
MISSING = ("no compiled kernels (no C++ compiler at installation?): everything runs by numpy and torch, several times "
           "slower")

Library = ctypes.CDLL

log = logging.getLogger("eddies")


@functools.cache
def library() -> ctypes.CDLL | None:
    """The library for this processor; None, and a line in the log the first time, where there is none."""
    found = instruction_sets()
    if not found:
        log.info(MISSING)
        return None
    return load(found[-1])


def instruction_sets() -> list[str]:
    """Those that the library is built for and this processor runs, the best one last."""
    built = [name for name in INSTRUCTION_SETS if _path(name).exists()]
    if "plain" not in built:
        return []
    best = load("plain").best_instruction_set()
    return [name for name in built if INSTRUCTION_SETS.index(name) <= best]


def in_use() -> str:
    """The instruction set of the library that serves this process, or "none"."""
    return (instruction_sets() or ["none"])[-1]


@functools.cache
def load(instruction_set: str) -> ctypes.CDLL:
    """The library for an instruction set that it is built for."""
    share_threads()
    return ctypes.CDLL(str(_path(instruction_set)))


@functools.cache
def share_threads() -> None:
    """Let what is loaded from here on, kernels and torch, take the threads of pyfftw's OpenMP runtime, which its wheel
    brings along: those of two runtimes would wait for each other, spinning on the same cores, and a step of the direct
    simulation take twenty times as long."""
    if threads() == 1:
        return
    import pyfftw  # noqa: F401
    with open("/proc/self/maps") as file:
        runtimes = {line.split()[-1] for line in file if "/libgomp" in line}
    for runtime in runtimes:
        ctypes.CDLL(runtime, mode=ctypes.RTLD_GLOBAL)


def _path(instruction_set: str) -> Path:
    return Path(__file__).with_name(f"{instruction_set}.so")
