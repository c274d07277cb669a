"""Fields from particles: sums at the points of a regular grid."""

import ctypes

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members
from eddies.kernels.neighbors import Box


class _Reconstruction(ctypes.Structure):
    _fields_ = (members(INT, "particles cells first_plane planes periodic_z") + members(NUMBER, "spacing support")
                + members(ADDRESS, "position kernel columns sums"))


def kernel_numbers(support: float, pieces: np.ndarray, signed: bool = False) -> tuple[float, ...]:
    """Return a smoothing kernel W as numbers for the library.

    Parameters
    ----------
    pieces : polynomial coefficients of W(r) on equal intervals of 0 <= r < support, (intervals, coefficients). They
        belong to u^0, u^1, ..., where u falls from 1 to 0 along an interval.
    signed : whether W may be negative.
    """
    return support, -np.inf if signed else 0.0, *map(float, pieces.shape), *map(float, pieces.ravel())


def sums_on_grid(box: Box, cells: int, planes: range, numbers: tuple[float, ...], position: np.ndarray,
                 columns: np.ndarray) -> np.ndarray:
    """Return the sums over the particles, sum_j c_j W(x - x_j), at the points x of a grid, (points, 4).

    `position` (n, 3) holds the x_j, and `columns` (n, 4) holds the c_j. The points are those in the consecutive
    `planes` of a grid of `cells`^3 points. `numbers` is the kernel W in the form that `kernel_numbers` returns. The
    result has the precision of the columns.
    """
    position, columns = np.ascontiguousarray(position, np.float64), np.ascontiguousarray(columns)
    if columns.shape != (len(position), 4):
        raise ValueError(f"columns {columns.shape} of {len(position)} particles: four are needed")
    sums, kernel = np.empty((len(planes) * cells**2, 4), columns.dtype), np.array(numbers)
    given = _Reconstruction(len(position), cells, planes.start, len(planes), box.periodic_z, box.length / cells,
                            numbers[0], *map(address, (position, kernel, columns, sums)))
    getattr(library(), f"reconstruction_sums_{columns.dtype}")(ctypes.byref(given))
    return sums
