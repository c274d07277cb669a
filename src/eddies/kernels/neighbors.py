"""Lists of neighbouring points, and the pairs in them, by the compiled library."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Box:
    """A box of this `length`, periodic along x and y, and along z or not."""

    length: float
    periodic_z: bool


class _Search(ctypes.Structure):
    _fields_ = [("receivers", ctypes.c_int64), ("senders", ctypes.c_int64), ("receiver", ctypes.c_void_p),
                ("sender", ctypes.c_void_p), ("length", ctypes.c_double), ("periodic_z", ctypes.c_int64),
                ("radius", ctypes.c_double), ("exclude_self", ctypes.c_int64), ("offsets", ctypes.c_void_p)]


class _Listed(ctypes.Structure):
    _fields_ = ([("count", ctypes.c_int64)]
                + [(name, ctypes.c_void_p) for name in ("rows", "offsets", "sender", "receivers", "positions")]
                + [("length", ctypes.c_double), ("periodic_z", ctypes.c_int64), ("radius", ctypes.c_double),
                   ("once", ctypes.c_int64)]
                + [(name, ctypes.c_void_p) for name in ("first", "receiver", "segment", "found", "displacement",
                                                        "distance")])


def neighbors_within(library: ctypes.CDLL, box: Box, radius: float, receivers: np.ndarray, senders: np.ndarray,
                     exclude_self: bool) -> tuple[np.ndarray, np.ndarray]:
    """The senders (s, 3) within a radius of each receiver (n, 3), in compressed rows: offsets (n + 1,) and numbers of
    senders. With `exclude_self` receiver i is sender i, and not its own neighbour. All positions must be finite."""
    receivers, senders = (np.ascontiguousarray(points, np.float64) for points in (receivers, senders))
    offsets = np.empty(len(receivers) + 1, np.int64)
    search = _Search(len(receivers), len(senders), _address(receivers), _address(senders), box.length, box.periodic_z,
                     radius, exclude_self, _address(offsets))
    library.neighbors_find.restype = ctypes.c_void_p
    kept = library.neighbors_find(ctypes.byref(search))
    found = np.empty(offsets[-1], np.int64)
    library.neighbors_take(ctypes.c_void_p(kept), ctypes.c_void_p(_address(found)))
    return offsets, found


def pairs_within(library: ctypes.CDLL, box: Box, radius: float, receivers: np.ndarray, senders: np.ndarray,
                 offsets: np.ndarray, listed: np.ndarray, rows: np.ndarray, once: bool,
                 kind: np.dtype) -> tuple[np.ndarray, ...]:
    """Those pairs of a list, of receivers `rows` (k,), that are within a radius now: rows of receiver, output and
    sender (m,), displacements (3, m) between nearest images, and distances (m,). With `once` the second of the two
    orders of a pair is left out."""
    receivers, senders = (np.ascontiguousarray(points, np.float64) for points in (receivers, senders))
    rows, first = np.ascontiguousarray(rows, np.int64), np.empty(len(rows) + 1, np.int64)
    given = _Listed(len(rows), *map(_address, (rows, offsets, listed, receivers, senders)), box.length,
                    box.periodic_z, radius, once, _address(first))
    library.neighbors_count(ctypes.byref(given))
    indices, count = np.empty((3, first[-1]), np.int64), first[-1]
    displacement, distance = np.empty((3, count), kind), np.empty(count, kind)
    given.receiver, given.segment, given.found = map(_address, indices)
    given.displacement, given.distance = _address(displacement), _address(distance)
    getattr(library, f"neighbors_fill_{np.dtype(kind)}")(ctypes.byref(given))
    return *indices, displacement, distance


def _address(array: np.ndarray) -> int:
    return array.ctypes.data
