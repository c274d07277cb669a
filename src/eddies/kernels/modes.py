"""Passes over the modes of a vector field by the compiled library, for conjugate gradients on solenoidal modes."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence

import numpy as np


class _Weights(ctypes.Structure):
    """Weights of modes as modes.cpp wants them."""

    _fields_ = ([(name, ctypes.c_int64) for name in ("z", "y", "x")]
                + [(name, ctypes.c_void_p) for name in ("kx", "ky", "kz", "multiplicity", "inverse_squared", "scale",
                                                        "penalty")])


class ModePasses:
    """What one iteration does to modes (3, kz, ky, kx).

    Real fields have inner products by their modes, of which each counts by its `multiplicity`.

    Parameters
    ----------
    wavevector : kx, ky, kz, to broadcast over (kz, ky, kx); `multiplicity` likewise, of kx alone.
    inverse_squared, scale, penalty : (kz, ky, kx); `scale` has the precision of all that follows.
    """

    def __init__(self, library: ctypes.CDLL, wavevector: Sequence[np.ndarray], multiplicity: np.ndarray,
                 inverse_squared: np.ndarray, scale: np.ndarray, penalty: np.ndarray) -> None:
        self._library, shape, self._kind = library, scale.shape, scale.dtype
        self._arrays = [np.ascontiguousarray(array, self._kind)
                        for array in (*wavevector, multiplicity, inverse_squared, scale, penalty)]
        sizes = [array.size for array in self._arrays]
        if sizes != [shape[2], shape[1], shape[0], shape[2], *3 * [scale.size]]:
            raise ValueError(f"weights of sizes {sizes} for modes of shape {shape}")
        self._shape, self._weights = shape, _Weights(*shape, *(array.ctypes.data for array in self._arrays))

    def image(self, given: np.ndarray, modes: np.ndarray) -> tuple[np.ndarray, float]:
        """P (scale given) + penalty modes, P the projection on solenoidal modes, and the inner product of that with
        `modes`, of this rank."""
        image = np.empty_like(modes)
        return image, self._call("modes_image", ctypes.c_double, [], [given, modes, image])

    def descend(self, length: float, inverse: np.ndarray, direction: np.ndarray, image: np.ndarray, found: np.ndarray,
                residual: np.ndarray) -> float:
        """found += length direction, residual -= length image, and the inner product of the residual with
        `inverse` times it, of this rank."""
        return self._call("modes_descend", ctypes.c_double, [length, inverse], [direction, image, found, residual])

    def turn(self, share: float, inverse: np.ndarray, residual: np.ndarray, direction: np.ndarray) -> None:
        """direction = inverse residual + share direction."""
        self._call("modes_turn", None, [share, inverse], [residual, direction])

    def _call(self, name: str, result: type | None, given: list, vectors: list[np.ndarray]) -> float:
        """Call a function with a number and an array (kz, ky, kx), or neither, and vectors."""
        needed = [(array, self._shape, self._kind) for array in given[1:]]
        needed += [(array, (3, *self._shape), np.result_type(self._kind, np.complex64)) for array in vectors]
        for array, shape, kind in needed:
            if array.shape != shape or array.dtype != kind or not array.flags.c_contiguous:
                raise ValueError(f"{name}: {array.dtype} {array.shape}, contiguous {kind} {shape} is needed")
        function = getattr(self._library, f"{name}_{self._kind}")
        function.restype = result
        return function(ctypes.byref(self._weights), *map(ctypes.c_double, given[:1]),
                        *(ctypes.c_void_p(array.ctypes.data) for array, _, _ in needed))
