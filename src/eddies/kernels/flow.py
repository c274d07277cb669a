"""Pointwise formulas of the direct numerical simulation by the compiled library."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence

import numpy as np

INT, ADDRESS, NUMBER = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double
_ARGUMENTS = {"advection": (INT, INT, ADDRESS, NUMBER, INT, ADDRESS), "cross": (INT, INT, ADDRESS, INT, ADDRESS),
              "project": 3 * (ADDRESS,), "decays": (ADDRESS, INT, INT, *3 * (ADDRESS,)),
              "acoustic_blocks": (ADDRESS, INT, *3 * (ADDRESS,))}


class _Modes(ctypes.Structure):
    """Modes as flow.cpp wants them."""

    _fields_ = [("cutoff", INT), ("lines", INT), ("kx", ADDRESS), ("ky", ADDRESS), ("kz", ADDRESS)]


class Formulas:
    """What is done to fields (c, ...) at grid points and to modes (c, kz, ky, kx) of a grid with these wavevectors.

    Terms of a sum are pairs of factors (kz >= 0, ky, n, kx), which are the same for -kz, and of a state. Arrays of the
    precision of the grid are needed, modes contiguous, fields each contiguous and any distance apart: ValueError
    otherwise.
    """

    def __init__(self, library: ctypes.CDLL, wavevector: Sequence[np.ndarray]) -> None:
        self._wavevector = [np.ascontiguousarray(axis) for axis in wavevector]
        self._real = self._wavevector[0].dtype
        x, y, z = (axis.size for axis in wavevector)
        self._shape, self._modes = (z, y, x), _Modes(x - 1, y, *(axis.ctypes.data for axis in self._wavevector))
        for name, arguments in _ARGUMENTS.items():
            function = getattr(library, f"flow_{name}_{self._real}")
            function.argtypes, function.restype = arguments, None
            setattr(self, f"_{name}", function)

    def advection(self, fields: np.ndarray, viscosity: float, out: np.ndarray) -> None:
        """-u.grad u + 2 nu (S - 1/3 div u).grad s  and  -u.grad s  (4, ...) of u, and the derivatives of (u, v, w, s)
        along x, along y and along z (15, ...)."""
        size = fields[0].size
        self._advection(size, *self._place(fields, 15, size), viscosity, *self._place(out, 4, size))

    def cross(self, fields: np.ndarray, out: np.ndarray) -> None:
        """u x omega (3, ...) of both, (6, ...)."""
        size = fields[0].size
        self._cross(size, *self._place(fields, 6, size), *self._place(out, 3, size))

    def project(self, vector: np.ndarray) -> np.ndarray:
        """u - k (k.u) / k^2."""
        self._require(vector, 3)
        result = np.empty_like(vector)
        self._project(ctypes.byref(self._modes), vector.ctypes.data, result.ctypes.data)
        return result

    def sum_of_decays(self, terms: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """The sum of factors, n = 1, times states."""
        components = len(terms[0][1])
        return self._sum(self._decays, [components], components, 1, terms)

    def sum_of_acoustic_blocks(self, terms: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        """The sum of states (4, ...), to each of which the acoustic block of its five factors is applied."""
        return self._sum(self._acoustic_blocks, [], 4, 5, terms)

    def _sum(self, function: Callable[..., None], counts: list[int], components: int, factors: int,
             terms: Sequence[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
        z, y, x = self._shape
        for given, state in terms:
            self._require(state, components)
            shape = ((z + 1) // 2, y, factors, x)
            if given.shape != shape or given.dtype != self._real or not given.flags.c_contiguous:
                raise ValueError(f"{given.dtype} {given.shape}: contiguous factors {shape} are needed")
        result = np.empty_like(terms[0][1])
        addresses = np.array([[array.ctypes.data for array in term] for term in terms], np.uint64).T.copy()
        function(ctypes.byref(self._modes), *counts, len(terms), addresses[0].ctypes.data, addresses[1].ctypes.data,
                 result.ctypes.data)
        return result

    def _require(self, modes: np.ndarray, components: int) -> None:
        if (modes.shape != (components, *self._shape) or modes.real.dtype != self._real or not np.iscomplexobj(modes)
                or not modes.flags.c_contiguous):
            raise ValueError(f"{modes.dtype} {modes.shape}: contiguous modes {(components, *self._shape)} of "
                             f"{self._real} are needed")

    def _place(self, fields: np.ndarray, count: int, size: int) -> tuple[int, int]:
        """How many numbers fields are apart, and their address."""
        if (len(fields) != count or fields[0].size != size or fields.dtype != self._real
                or not fields[0].flags.c_contiguous):
            raise ValueError(f"{fields.dtype} {fields.shape}: {count} fields of contiguous {self._real}, {size} values "
                             "each, are needed")
        return fields.strides[0] // self._real.itemsize, fields.ctypes.data
