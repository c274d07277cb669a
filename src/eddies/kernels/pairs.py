"""Sums over pairs of particles within a radius, and gradients through them, by the compiled library."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

MOST_SCALARS = 4
# What calls return: else the first particle whose position is not finite.
DONE, UNKNOWN, NO_GRADIENT = -1, -2, -3


@dataclass(frozen=True)
class Summand:
    """One thing to sum: its `kind`, by the name that summands.hpp declares; the numbers that it takes; what the second
    particle of a mutual pair gets of each component, times that of the first; and the first of those columns of numbers
    of particles that it reads."""

    kind: str
    numbers: tuple[float, ...]
    parity: tuple[float, ...]
    scalar: int = 0


def kinds(library: ctypes.CDLL) -> list[str]:
    """Names of the summands that the library has."""
    library.pair_summand.restype = ctypes.c_char_p
    found: list[str] = []
    while name := library.pair_summand(ctypes.c_int64(len(found))):
        found.append(name.decode())
    return found


@dataclass(frozen=True)
class PairSpace:
    """Where pairs are: a box of this `length`, periodic along z or not, the `radius` within which particles are pairs,
    and the units of what they carry; `mutual`: each pair is evaluated once, as what j gets of i follows from what i
    gets of j."""

    length: float
    periodic_z: bool
    radius: float
    length_unit: float
    velocity_unit: float
    mutual: bool


class _Particles(ctypes.Structure):
    _fields_ = ([(name, ctypes.c_int64) for name in ("count", "scalars")]
                + [(name, ctypes.c_void_p) for name in ("position", "velocity", "scalar", "wanted")]
                + [("length", ctypes.c_double), ("periodic_z", ctypes.c_int64)]
                + [(name, ctypes.c_double) for name in ("radius", "length_unit", "velocity_unit")]
                + [("mutual", ctypes.c_int64)])


class _Given(ctypes.Structure):
    _fields_ = ([("kind", ctypes.c_char_p)]
                + [(name, ctypes.c_int64) for name in ("numbers_count", "parameters_count", "components", "scalar")]
                + [(name, ctypes.c_void_p) for name in ("numbers", "parameters", "parity", "sums", "by_sums",
                                                        "by_parameters")])


class CompiledPairs:
    """Pairs of particles, of which sums are asked for at those `wanted`.

    Parameters
    ----------
    position, velocity : (n, 3). scalars : (k, n), k at most MOST_SCALARS, in the units of the summands.
    wanted : bool (n,).
    kind : float32 or float64, of the arithmetic.
    """

    def __init__(self, library: ctypes.CDLL, space: PairSpace, position: np.ndarray, velocity: np.ndarray,
                 scalars: np.ndarray, wanted: np.ndarray, kind: np.dtype) -> None:
        count = len(position)
        if position.shape != (count, 3) or velocity.shape != (count, 3) or wanted.shape != (count,) or \
                scalars.shape[1:] != (count,) or len(scalars) > MOST_SCALARS:
            raise ValueError(f"columns {position.shape}, {velocity.shape}, {scalars.shape}, {wanted.shape} are not "
                             "those of one set of particles")
        self._library, self._kind, self._count = library, np.dtype(kind), count
        self._columns = [np.ascontiguousarray(column, np.float64) for column in (position, velocity, scalars)]
        self._columns.append(np.ascontiguousarray(wanted, np.uint8))
        self._particles = _Particles(
            count, len(scalars), *map(_address, self._columns), space.length, space.periodic_z, space.radius,
            space.length_unit, space.velocity_unit, space.mutual)

    def sums(self, summands: Sequence[Summand], parameters: Sequence[np.ndarray]) -> list[np.ndarray]:
        """The sums of each summand with its parameters, (components, n): only of those wanted to be used. Raises
        ValueError where a position is not finite, and where the library has no such summand."""
        found = [np.empty((len(summand.parity), self._count), self._kind) for summand in summands]
        self._call("pair_sums", summands, parameters, "sums", found)
        return found

    def gradients(self, summands: Sequence[Summand], parameters: Sequence[np.ndarray], by_sums: Sequence[np.ndarray],
                  columns: bool) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
        """From gradients by the sums, zero where none are wanted: those by the parameters, and, if asked for, by
        position, velocity and scalars. Raises ValueError as `sums`, and where a summand has none."""
        by_parameters = [np.zeros(len(values)) for values in parameters]
        by_columns = tuple(np.empty_like(column) for column in self._columns[:3]) if columns else ()
        given = (ctypes.c_void_p * 3)(*map(_address, by_columns))
        self._call("pair_gradients", summands, parameters, "by_sums",
                   [np.ascontiguousarray(by, self._kind) for by in by_sums], by_parameters, ctypes.byref(given))
        return by_parameters, by_columns

    def _call(self, name: str, summands: Sequence[Summand], parameters: Sequence[np.ndarray], field: str,
              sums: Sequence[np.ndarray], by_parameters: Sequence[np.ndarray] = (), *more: object) -> None:
        structures, held = (_Given * len(summands))(), []
        for number, (summand, values, columns) in enumerate(zip(summands, parameters, sums)):
            arrays = [np.ascontiguousarray(given, np.float64) for given in (summand.numbers, values, summand.parity)]
            held.append(arrays)
            given = structures[number]
            given.kind, given.scalar = summand.kind.encode(), summand.scalar
            given.numbers_count, given.parameters_count, given.components = map(len, arrays)
            given.numbers, given.parameters, given.parity = map(_address, arrays)
            setattr(given, field, _address(columns))
            if by_parameters:
                given.by_parameters = _address(by_parameters[number])
        function = getattr(self._library, f"{name}_{self._kind}")
        function.restype = ctypes.c_int64
        result = function(ctypes.byref(self._particles), ctypes.c_int64(len(summands)), structures, *more)
        if result != DONE:
            told = {UNKNOWN: f"no such summands: {summands}", NO_GRADIENT: f"one without a gradient of {summands}"}
            raise ValueError(f"pairs: {told.get(result, f'the position of particle {result} is not finite')}")


def _address(array: np.ndarray) -> int:
    return array.ctypes.data
