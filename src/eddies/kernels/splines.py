"""B-splines around points: interpolation from the planes of a grid, and its transpose."""

import ctypes
from collections.abc import Sequence

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members

# Padding of `fraction` along each axis, since the library may read beyond the last point; the same in splines.cpp.
PADDING = 8


class MisplacedPoint(ValueError):
    """A point is not finite, or its splines reach beyond the planes. `number` is the index of the first such point."""

    def __init__(self, number: int) -> None:
        super().__init__(f"point {number} has no place among the planes")
        self.number = number


class _Cloud(ctypes.Structure):
    _fields_ = members(INT, "points cells planes degree") + members(ADDRESS, "order first fraction starts")


class Splines:
    """The (degree + 1)^3 tensor-product B-splines around each of n points, for interpolation of degree 3 or 5.

    The grid is periodic and has `cells`^3 points. A rank holds consecutive planes of it, its own and ghost planes;
    `planes` are their indices. The methods take the values in these planes as `parts`, three arrays (components,
    planes, y, x): ghosts below, own planes, ghosts above. `positions` (n, 3) are periodic in x, y and z, but the
    splines must lie within the planes. The constructor sorts the points once. It raises MisplacedPoint.
    """

    def __init__(self, degree: int, positions: np.ndarray, cells: int, spacing: float, planes: range) -> None:
        self._spacing, count = spacing, len(positions)
        positions = np.ascontiguousarray(positions, np.float64)  # a copy must live until the call has ended
        self._arrays = {"order": np.empty(count, np.int32), "first": np.empty((count, 3), np.int32),
                        "fraction": np.zeros((3, count + PADDING)),
                        "starts": np.empty(library().splines_bins(cells, len(planes)) + 1, np.int64)}
        self._cloud = _Cloud(count, cells, len(planes), degree, *map(address, self._arrays.values()))
        library().splines_arrange.restype = INT
        misplaced = library().splines_arrange(ctypes.byref(self._cloud), ADDRESS(address(positions)),
                                              NUMBER(spacing), INT(planes.start))
        if misplaced >= 0:
            raise MisplacedPoint(misplaced)

    def at(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """Return the values (n, c) at the points, as float64, from planes of coefficients. They are summed in the
        precision of the planes."""
        values = np.empty((self._cloud.points, len(parts[0])))
        self._call("splines_at", _contiguous(parts), values)
        return values

    def slope(self, parts: Sequence[np.ndarray], factors: np.ndarray) -> np.ndarray:
        """Return, at each point, the spatial gradient of sum_c factors_c f_c, (n, 3). f_c are the interpolated fields;
        the `factors` (n, c) of a point are constant in space."""
        gradients = np.empty((self._cloud.points, 3))
        self._call("splines_slope", _contiguous(parts), np.ascontiguousarray(factors, np.float64), gradients)
        return gradients / self._spacing

    def spread(self, values: np.ndarray, parts: Sequence[np.ndarray]) -> None:
        """Add values (n, c) to planes by the transpose of `at`. Planes must be contiguous and of one precision."""
        self._call("splines_spread", parts, np.ascontiguousarray(values, np.float64))

    def _call(self, name: str, parts: Sequence[np.ndarray], *columns: np.ndarray) -> None:
        """Call a library function on planes and on `columns`, arrays with one row for each point.

        The function gets the address of each plane of each component, and the address of each column.
        """
        kind = parts[0].dtype
        if any(part.dtype != kind or not part[0, 0].flags.c_contiguous for part in parts):
            raise ValueError(f"planes of {[part.dtype for part in parts]}: contiguous planes of one type are needed")
        rows = [part.ctypes.data + part.strides[0] * np.arange(len(part))[:, None]
                + part.strides[1] * np.arange(part.shape[1]) for part in parts]
        planes = np.concatenate(rows, axis=1, dtype=np.uint64, casting="unsafe")
        if planes.shape[1] != self._cloud.planes or any(len(column) != self._cloud.points for column in columns):
            raise ValueError(f"{planes.shape[1]} planes, columns of {[len(column) for column in columns]}: "
                             f"{self._cloud.planes} planes and {self._cloud.points} points are needed")
        arguments = [ADDRESS(address(array)) for array in (planes, *columns)]
        getattr(library(), f"{name}_{kind}")(ctypes.byref(self._cloud), INT(len(planes)), *arguments)


def _contiguous(parts: Sequence[np.ndarray]) -> list[np.ndarray]:
    kind = np.result_type(*parts, np.float32)
    return [part.astype(kind, order="C", copy=False) for part in parts]
