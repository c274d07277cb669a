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


def sums_on_grid(library: ctypes.CDLL, grid: GridPlanes, told: tuple[float, ...], position: np.ndarray,
                 columns: np.ndarray) -> np.ndarray:
    """sum_j c_j W(x - x_j) of columns c (n, 4) of particles (n, 3) at the points of the planes, (points, 4), in the
    precision of the columns; W as `told_kernel` tells it."""
    position, columns = np.ascontiguousarray(position, np.float64), np.ascontiguousarray(columns)
    if columns.shape != (len(position), 4):
        raise ValueError(f"columns {columns.shape} of {len(position)} particles: four are needed")
    sums = np.empty((grid.planes * grid.cells**2, 4), columns.dtype)
    kernel = np.array(told)
    given = _Reconstruction(len(position), grid.cells, grid.first, grid.planes, grid.periodic_z, grid.spacing, told[0],
                            *(array.ctypes.data for array in (position, kernel, columns, sums)))
    getattr(library, f"reconstruction_sums_{columns.dtype}")(ctypes.byref(given))
    return sums


def told_kernel(support: float, pieces: np.ndarray, signed: bool = False) -> tuple[float, ...]:
    """A smoothing kernel as the library wants it: where it ends, its least value (none of a `signed` one), and W in
    each of equally long pieces, the coefficients of u^0, u^1, ... for u = 1 ... 0 there, (pieces, coefficients)."""
    return support, -np.inf if signed else 0.0, *map(float, pieces.shape), *map(float, pieces.ravel())
