"""Lists of neighbouring points, and the pairs in them."""

import ctypes
from dataclasses import dataclass

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members


@dataclass(frozen=True)
class Box:
    """A box of edge `length`, periodic along x and y, and along z if `periodic_z`."""

    length: float
    periodic_z: bool


class _Search(ctypes.Structure):
    _fields_ = (members(INT, "receivers senders") + members(ADDRESS, "receiver sender") + members(NUMBER, "length")
                + members(INT, "periodic_z") + members(NUMBER, "radius") + members(INT, "exclude_self")
                + members(ADDRESS, "offsets"))


class _Listed(ctypes.Structure):
    _fields_ = (members(INT, "count") + members(ADDRESS, "rows offsets listed receivers positions")
                + members(NUMBER, "length") + members(INT, "periodic_z") + members(NUMBER, "radius")
                + members(ADDRESS, "first receiver segment sender displacement distance"))


def neighbors_within(box: Box, radius: float, receivers: np.ndarray, senders: np.ndarray,
                     exclude_self: bool) -> tuple[np.ndarray, np.ndarray]:
    """Find the senders (s, 3) within a radius of each receiver (n, 3). Returns `offsets` (n + 1,) and `rows` (m,).

    The neighbours of receiver i are the senders with indices `rows[offsets[i]:offsets[i + 1]]`. With `exclude_self`,
    receiver i and sender i are one particle, which is not its own neighbour. All positions must be finite.
    """
    receivers, senders = (np.ascontiguousarray(points, np.float64) for points in (receivers, senders))
    offsets = np.empty(len(receivers) + 1, np.int64)
    search = _Search(len(receivers), len(senders), address(receivers), address(senders), box.length, box.periodic_z,
                     radius, exclude_self, address(offsets))
    library().neighbors_find.restype = ctypes.c_void_p
    handle = library().neighbors_find(ctypes.byref(search))
    rows = np.empty(offsets[-1], np.int64)
    library().neighbors_take(ctypes.c_void_p(handle), ctypes.c_void_p(address(rows)))
    return offsets, rows


def pairs_within(box: Box, radius: float, receivers: np.ndarray, senders: np.ndarray, offsets: np.ndarray,
                 listed: np.ndarray, rows: np.ndarray, kind: np.dtype) -> tuple[np.ndarray, ...]:
    """Find those pairs of a neighbour list that lie within `radius` at the given positions, for some receivers.

    `rows` (k,) are the indices of these receivers. `offsets` and `listed` are the result of `neighbors_within`. Returns
    five arrays for the m pairs: index of the receiver (m,), its place in `rows` (m,), index of the sender (m,),
    displacement x_receiver - x_sender between nearest images (3, m), and distance (m,).
    """
    receivers, senders = (np.ascontiguousarray(points, np.float64) for points in (receivers, senders))
    rows, first = np.ascontiguousarray(rows, np.int64), np.empty(len(rows) + 1, np.int64)
    given = _Listed(len(rows), *map(address, (rows, offsets, listed, receivers, senders)), box.length,
                    box.periodic_z, radius, address(first))
    library().neighbors_count(ctypes.byref(given))
    indices, count = np.empty((3, first[-1]), np.int64), first[-1]
    displacement, distance = np.empty((3, count), kind), np.empty(count, kind)
    given.receiver, given.segment, given.sender = map(address, indices)
    given.displacement, given.distance = address(displacement), address(distance)
    getattr(library(), f"neighbors_fill_{np.dtype(kind)}")(ctypes.byref(given))
    return *indices, displacement, distance
