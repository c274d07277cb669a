"""Loops over the modes of a vector field, for the method of conjugate gradients on solenoidal modes."""

import ctypes
from collections.abc import Sequence

import numpy as np

from eddies.kernels.library import ADDRESS, INT, address, library, members, require


class _Weights(ctypes.Structure):
    _fields_ = members(INT, "z y x") + members(ADDRESS, "kx ky kz multiplicity inverse_squared scale penalty")


class ModePasses:
    """The operations of one iteration of conjugate gradients on modes (3, kz, ky, kx).

    The inner product <a, b> of real fields is a sum over the modes of this rank. Each mode counts `multiplicity` times.
    In the methods, `inverse` (kz, ky, kx) holds the factors of the preconditioner.

    Parameters
    ----------
    wavevector : kx, ky and kz, each of a shape that broadcasts to (kz, ky, kx).
    multiplicity : number of times that a stored mode is counted; it depends on kx alone.
    inverse_squared, scale, penalty : (kz, ky, kx), 1/k^2 and the factors in `apply`. All arrays have the precision of
        `scale`.
    """

    def __init__(self, wavevector: Sequence[np.ndarray], multiplicity: np.ndarray, inverse_squared: np.ndarray,
                 scale: np.ndarray, penalty: np.ndarray) -> None:
        self._shape, self._kind = scale.shape, scale.dtype
        self._arrays = [np.ascontiguousarray(array, self._kind)
                        for array in (*wavevector, multiplicity, inverse_squared, scale, penalty)]
        z, y, x = self._shape
        sizes = [array.size for array in self._arrays]
        if sizes != [x, y, z, x, *3 * [scale.size]]:
            raise ValueError(f"weights of sizes {sizes} for modes of shape {self._shape}")
        self._weights = _Weights(z, y, x, *map(address, self._arrays))

    def apply(self, given: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, float]:
        """Return I = P (scale * given) + penalty * modes, and <I, modes>. P projects on solenoidal modes."""
        applied = np.empty_like(modes)
        return applied, self._call("modes_image", ctypes.c_double, [], [given, modes, applied])

    def descend(self, length: float, inverse: np.ndarray, direction: np.ndarray, applied: np.ndarray,
                solution: np.ndarray, residual: np.ndarray) -> float:
        """Add length * direction to `solution` and subtract length * applied from `residual`, both in place. Return
        <residual, inverse * residual> of the new residual."""
        return self._call("modes_descend", ctypes.c_double, [length, inverse], [direction, applied, solution, residual])

    def update_direction(self, beta: float, inverse: np.ndarray, residual: np.ndarray, direction: np.ndarray) -> None:
        """Replace `direction` by inverse * residual + beta * direction, in place."""
        self._call("modes_turn", None, [beta, inverse], [residual, direction])

    def _call(self, name: str, result: type | None, given: list, vectors: list[np.ndarray]) -> float:
        """Call a function of the library with `vectors` and with `given`, which is empty or holds a number and an array
        (kz, ky, kx)."""
        for array in given[1:]:
            require(array, self._shape, self._kind)
        for vector in vectors:
            require(vector, (3, *self._shape), np.result_type(self._kind, np.complex64))
        function = getattr(library(), f"{name}_{self._kind}")
        function.restype = result
        return function(ctypes.byref(self._weights), *map(ctypes.c_double, given[:1]),
                        *(ctypes.c_void_p(address(array)) for array in (*given[1:], *vectors)))
