"""B-splines around points, between these and the planes of a grid, by the compiled library."""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

# What may be read behind the fractions along an axis; splines.cpp has it too.
PADDING = 8


@dataclass(frozen=True)
class PaddedPlanes:
    """Those planes of a periodic grid of `cells`^3 points, `spacing` apart, that a rank has: so many, from number
    `lowest` on. They come in parts (components, planes, y, x) that follow each other, ghosts, own ones, ghosts."""

    cells: int
    spacing: float
    lowest: int
    planes: int


class MisplacedPoint(ValueError):
    """A point, the first of them of this `number`, whose position is not finite or whose splines need more planes than
    there are."""

    def __init__(self, number: int) -> None:
        super().__init__(f"point {number} has no place among the planes")
        self.number = number


class _Cloud(ctypes.Structure):
    """Points as splines.cpp wants them."""

    _fields_ = ([(name, ctypes.c_int64) for name in ("points", "cells", "planes", "degree")]
                + [(name, ctypes.c_void_p) for name in ("order", "first", "fraction", "starts")])


class Splines:
    """The (degree + 1)^3 tensor-product B-splines around each of some points (n, 3), of degree 3 or 5.

    x and y are periodic; z, periodically, must be where there are planes. Planes are given as parts that follow each
    other, (c, planes, y, x) each. Points are put in order of place here, once. Raises MisplacedPoint.
    """

    def __init__(self, library: ctypes.CDLL, degree: int, positions: np.ndarray, padded: PaddedPlanes) -> None:
        self._library, self._padded, count = library, padded, len(positions)
        positions = _doubles(positions)  # to live until the call has ended
        sizes = padded.cells, padded.planes
        self._arrays = {"order": np.empty(count, np.int32), "first": np.empty((count, 3), np.int32),
                        "fraction": np.zeros((3, count + PADDING)),
                        "starts": np.empty(library.splines_bins(*sizes) + 1, np.int64)}
        self._cloud = _Cloud(count, *sizes, degree, *(array.ctypes.data for array in self._arrays.values()))
        arrange = library.splines_arrange
        arrange.restype = ctypes.c_int64
        misplaced = arrange(ctypes.byref(self._cloud), _address(positions), ctypes.c_double(padded.spacing),
                            ctypes.c_int64(padded.lowest))
        if misplaced >= 0:
            raise MisplacedPoint(misplaced)

    def at(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Values (n, c) of planes in single or double precision, in which they are summed."""
        values = np.empty((self._cloud.points, len(parts[0])))
        self._call("splines_at", _alike(parts), values)
        return values

    def slope(self, parts: Sequence[np.ndarray], factors: np.ndarray) -> np.ndarray:
        """Gradient (n, 3) with respect to the positions of sum_c factors_c f_c, the factors (n, c) held fixed."""
        gradients = np.empty((self._cloud.points, 3))
        self._call("splines_slope", _alike(parts), _doubles(factors), gradients)
        return gradients / self._padded.spacing

    def spread(self, values: np.ndarray, parts: Sequence[np.ndarray]) -> None:
        """Transpose of `at`: values (n, c) added to planes, contiguous and in one precision."""
        self._call("splines_spread", parts, _doubles(values))

    def _call(self, name: str, parts: Sequence[np.ndarray], *columns: np.ndarray) -> None:
        """Call a function of the library with the addresses of planes (components, planes) and columns of points."""
        kind = parts[0].dtype
        if any(part.dtype != kind or not part[0, 0].flags.c_contiguous for part in parts):
            raise ValueError(f"planes of {[part.dtype for part in parts]}: contiguous ones in one precision are needed")
        rows = [part.ctypes.data + part.strides[0] * np.arange(len(part))[:, None]
                + part.strides[1] * np.arange(part.shape[1]) for part in parts]
        planes = np.concatenate(rows, axis=1, dtype=np.uint64, casting="unsafe")
        if planes.shape[1] != self._padded.planes or any(len(column) != self._cloud.points for column in columns):
            raise ValueError(f"{planes.shape[1]} planes, columns of {[len(column) for column in columns]}: "
                             f"{self._padded.planes} planes and {self._cloud.points} points are needed")
        function = getattr(self._library, f"{name}_{kind}")
        function(ctypes.byref(self._cloud), ctypes.c_int64(len(planes)), _address(planes), *map(_address, columns))


def _alike(parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    kind = np.result_type(*parts, np.float32)
    return [part.astype(kind, order="C", copy=False) for part in parts]


def _doubles(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array, np.float64)


def _address(array: np.ndarray) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
