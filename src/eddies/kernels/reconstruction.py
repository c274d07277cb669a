"""Sums over particles at the points of a regular grid, by the compiled library."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class GridPlanes:
    """Planes of a grid of `cells`^2 points each, `spacing` apart, from number `first` on, `planes` of them; periodic
    along z or not."""

    cells: int
    spacing: float
    first: int
    planes: int
    periodic_z: bool


class _Reconstruction(ctypes.Structure):
    _fields_ = ([(name, ctypes.c_int64) for name in ("particles", "cells", "first_plane", "planes", "periodic_z")]
                + [("spacing", ctypes.c_double), ("support", ctypes.c_double)]
                + [(name, ctypes.c_void_p) for name in ("position", "kernel", "columns", "sums")])


def sums_on_grid(library: ctypes.CDLL, grid: GridPlanes, support: float, pieces: np.ndarray, position: np.ndarray,
                 columns: np.ndarray) -> np.ndarray:
    """sum_j c_j W(x - x_j) of columns c (n, 4) of particles (n, 3) at the points of the planes, (points, 4), in the
    precision of the columns. W ends at `support`; its `pieces` are as `told_kernel` tells them."""
    position, columns = np.ascontiguousarray(position, np.float64), np.ascontiguousarray(columns)
    if columns.shape != (len(position), 4):
        raise ValueError(f"columns {columns.shape} of {len(position)} particles: four are needed")
    sums = np.empty((grid.planes * grid.cells**2, 4), columns.dtype)
    told = np.array(told_kernel(support, pieces))
    given = _Reconstruction(len(position), grid.cells, grid.first, grid.planes, grid.periodic_z, grid.spacing, support,
                            *(array.ctypes.data for array in (position, told, columns, sums)))
    getattr(library, f"reconstruction_sums_{columns.dtype}")(ctypes.byref(given))
    return sums


def told_kernel(support: float, pieces: np.ndarray) -> tuple[float, ...]:
    """A smoothing kernel as the library wants it: where it ends, and W in each of equally long pieces, the coefficients
    of u^0, u^1, ... for u = 1 ... 0 there, (pieces, coefficients)."""
    return support, *map(float, pieces.shape), *map(float, pieces.ravel())
