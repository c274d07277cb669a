"""Moving least squares among listed particles, by the compiled library."""

from __future__ import annotations

import ctypes

import numpy as np

from eddies.kernels.neighbors import Box

FUNCTIONS = {1: "fit_linear", 2: "fit_quadratic"}


class _Fit(ctypes.Structure):
    _fields_ = ([("receivers", ctypes.c_int64), ("periodic_z", ctypes.c_int64)]
                + [(name, ctypes.c_double) for name in ("length", "volume", "ridge")]
                + [(name, ctypes.c_void_p) for name in ("offsets", "senders", "receiver", "position", "value", "kernel",
                                                        "found")])


def fitted(library: ctypes.CDLL, box: Box, degree: int, told: tuple[float, ...], volume: float, ridge: float,
           offsets: np.ndarray, senders: np.ndarray, receivers: np.ndarray, positions: np.ndarray,
           values: np.ndarray) -> np.ndarray:
    """Value and its derivatives by x, y and z, (n, 4, 3), of the polynomials of a degree, 1 or 2, that fit three
    columns of values best: see `eddies.particles.particle_field.ParticleField.fitted` for the definition.

    Parameters
    ----------
    told : the weight, as `told_kernel` tells it. volume : mean volume of a particle. ridge : see the definition.
    offsets, senders : int64 (n + 1,) and (m,), the particles listed near each receiver; they may be too far.
    receivers (n, 3), positions and values (s, 3), in double precision.

    Raises ValueError for another degree, or columns of values other than three.
    """
    if degree not in FUNCTIONS or values.shape != positions.shape or positions.shape[1:] != (3,):
        raise ValueError(f"moving least squares of degree {degree}, values {values.shape} of positions "
                         f"{positions.shape}: degree 1 or 2 and three columns are needed")
    kernel = np.array(told)
    offsets, senders = (np.ascontiguousarray(numbers, np.int64) for numbers in (offsets, senders))
    receivers, positions, values = (np.ascontiguousarray(a, np.float64) for a in (receivers, positions, values))
    found = np.empty((len(receivers), 4, 3))
    given = _Fit(len(receivers), box.periodic_z, box.length, volume, ridge,
                 *(a.ctypes.data for a in (offsets, senders, receivers, positions, values, kernel, found)))
    getattr(library, FUNCTIONS[degree])(ctypes.byref(given))
    return found
