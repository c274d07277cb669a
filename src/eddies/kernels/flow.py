"""Pointwise formulas of the direct numerical simulation."""

import ctypes
from collections.abc import Callable, Sequence

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members, require

_ARGUMENTS = {"advection": (INT, INT, ADDRESS, NUMBER, INT, ADDRESS), "cross": (INT, INT, ADDRESS, INT, ADDRESS),
              "project": 3 * (ADDRESS,), "decays": (ADDRESS, INT, INT, *3 * (ADDRESS,)),
              "acoustic_blocks": (ADDRESS, INT, *3 * (ADDRESS,))}

Terms = Sequence[tuple[np.ndarray, np.ndarray]]


class _Modes(ctypes.Structure):
    _fields_ = members(INT, "cutoff lines") + members(ADDRESS, "kx ky kz")


class Formulas:
    """Formulas for fields (c, ...) at grid points and for modes (c, kz, ky, kx).

    `wavevector` holds the components kx, ky and kz of the modes. The methods `sum_of_...` add terms, which are pairs
    (factors, state). A state holds modes. Its factors (kz, ky, n, kx) are n real numbers per mode. They are stored for
    kz >= 0 only, because they are equal for kz and -kz. Arrays must have the precision of the wavevectors. Modes must
    be contiguous, and each field must be contiguous; ValueError otherwise.
    """

    def __init__(self, wavevector: Sequence[np.ndarray]) -> None:
        self._wavevector = [np.ascontiguousarray(axis) for axis in wavevector]
        self._real = self._wavevector[0].dtype
        self._complex = np.result_type(self._real, np.complex64)
        x, y, z = (axis.size for axis in wavevector)
        self._shape, self._modes = (z, y, x), _Modes(x - 1, y, *map(address, self._wavevector))
        for name, arguments in _ARGUMENTS.items():
            function = getattr(library(), f"flow_{name}_{self._real}")
            function.argtypes, function.restype = arguments, None
            setattr(self, f"_{name}", function)

    def advection(self, fields: np.ndarray, viscosity: float, out: np.ndarray) -> None:
        """Write -u.grad u + 2 nu (S - 1/3 div u).grad s and -u.grad s to `out` (4, ...).

        u is the velocity, S the rate of strain, s the logarithm of the density and nu the `viscosity`.
        `fields` (15, ...) holds the vector u, then the derivatives of (u, v, w, s) along x, along y and along z.
        """
        size = fields[0].size
        self._advection(size, *self._place(fields, 15, size), viscosity, *self._place(out, 4, size))

    def cross(self, fields: np.ndarray, out: np.ndarray) -> None:
        """Write u x omega to `out` (3, ...). `fields` (6, ...) holds the velocity u, then the vorticity omega."""
        size = fields[0].size
        self._cross(size, *self._place(fields, 6, size), *self._place(out, 3, size))

    def project(self, vector: np.ndarray) -> np.ndarray:
        """Return u - k (k.u) / k^2, where u are the modes `vector` (3, kz, ky, kx)."""
        require(vector, (3, *self._shape), self._complex)
        result = np.empty_like(vector)
        self._project(ctypes.byref(self._modes), address(vector), address(result))
        return result

    def sum_of_decays(self, terms: Terms) -> np.ndarray:
        """Return the sum of factors (n = 1) times states (c, kz, ky, kx)."""
        components = len(terms[0][1])
        return self._sum(self._decays, [components], components, 1, terms)

    def sum_of_acoustic_blocks(self, terms: Terms) -> np.ndarray:
        """Return the sum of states (4, kz, ky, kx). Before the sum, `add_acoustic_block` in flow.cpp maps each state
        with its factors (n = 5)."""
        return self._sum(self._acoustic_blocks, [], 4, 5, terms)

    def _sum(self, function: Callable[..., None], counts: list[int], components: int, factors: int,
             terms: Terms) -> np.ndarray:
        z, y, x = self._shape
        shape = ((z + 1) // 2, y, factors, x)
        for factor, state in terms:
            require(state, (components, *self._shape), self._complex)
            require(factor, shape, self._real)
        result = np.empty_like(terms[0][1])
        addresses = np.array([[address(array) for array in term] for term in terms], np.uint64).T.copy()
        function(ctypes.byref(self._modes), *counts, len(terms), address(addresses[0]), address(addresses[1]),
                 address(result))
        return result

    def _place(self, fields: np.ndarray, count: int, size: int) -> tuple[int, int]:
        if (len(fields) != count or fields[0].size != size or fields.dtype != self._real
                or not fields[0].flags.c_contiguous):
            raise ValueError(f"{fields.dtype} {fields.shape}: {count} contiguous fields of {self._real}, {size} values "
                             "each, are needed")
        return fields.strides[0] // self._real.itemsize, address(fields)
