"""Sums over pairs of particles within a radius, and gradients through them."""

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, address, library, members

MOST_SCALARS = 4
# Results of a library function. Any other result is the number of the first particle whose position is not finite.
DONE, UNKNOWN, NO_GRADIENT = -1, -2, -3


@dataclass(frozen=True)
class Summand:
    """A quantity to sum over pairs: its name `kind` and its constants `numbers`, as in summands.hpp.

    If each pair is evaluated once (`PairSpace.mutual`), its second particle gets the first one's value times `parity`
    (components,). The summand reads the scalar columns of `CompiledPairs` from index `scalar` on.
    """

    kind: str
    numbers: tuple[float, ...]
    parity: tuple[float, ...]
    scalar: int = 0


@dataclass(frozen=True)
class PairSpace:
    """The box of the pairs, the distance `radius` within which two particles are a pair, and the units of the summands.

    If `mutual` is true, each pair is evaluated once, for both particles.
    """

    length: float
    periodic_z: bool
    radius: float
    length_unit: float
    velocity_unit: float
    mutual: bool


class _Particles(ctypes.Structure):
    _fields_ = (members(INT, "count scalars") + members(ADDRESS, "position velocity scalar wanted")
                + members(NUMBER, "length") + members(INT, "periodic_z")
                + members(NUMBER, "radius length_unit velocity_unit") + members(INT, "mutual"))


class _Given(ctypes.Structure):
    _fields_ = (members(ctypes.c_char_p, "kind") + members(INT, "numbers_count parameters_count components scalar")
                + members(ADDRESS, "numbers parameters parity sums by_sums by_parameters"))


class CompiledPairs:
    """Computes sums over the pairs of n particles, in the precision `kind`, for the particles `wanted`, bool (n,).

    `position` and `velocity` have the shape (n, 3). `scalars` (k, n) are at most MOST_SCALARS further columns of the
    particles, in the units of the summands. Raises ValueError for other shapes.
    """

    def __init__(self, space: PairSpace, position: np.ndarray, velocity: np.ndarray, scalars: np.ndarray,
                 wanted: np.ndarray, kind: np.dtype) -> None:
        count = len(position)
        if position.shape != (count, 3) or velocity.shape != (count, 3) or wanted.shape != (count,) or \
                scalars.shape[1:] != (count,) or len(scalars) > MOST_SCALARS:
            raise ValueError(f"columns {position.shape}, {velocity.shape}, {scalars.shape}, {wanted.shape} do not "
                             "belong to one set of particles")
        self._kind, self._count = np.dtype(kind), count
        self._columns = [np.ascontiguousarray(column, np.float64) for column in (position, velocity, scalars)]
        self._columns.append(np.ascontiguousarray(wanted, np.uint8))
        self._particles = _Particles(
            count, len(scalars), *map(address, self._columns), space.length, space.periodic_z, space.radius,
            space.length_unit, space.velocity_unit, space.mutual)

    def sums(self, summands: Sequence[Summand], parameters: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return for each summand, with its parameters, the sums (components, n). They are valid only at the wanted
        particles.

        Raises ValueError if a position is not finite or the library has no such summand.
        """
        sums = [np.empty((len(summand.parity), self._count), self._kind) for summand in summands]
        self._call("pair_sums", summands, parameters, "sums", sums)
        return sums

    def gradients(self, summands: Sequence[Summand], parameters: Sequence[np.ndarray], by_sums: Sequence[np.ndarray],
                  columns: bool) -> tuple[list[np.ndarray], tuple[np.ndarray, ...]]:
        """Return the gradients of a loss with respect to each of `parameters`, and those with respect to position,
        velocity and scalars as a tuple.

        `by_sums` are the gradients of the loss with respect to the sums (components, n) of each summand. They must be
        zero at particles that are not wanted. The tuple is empty unless `columns` is true. Raises ValueError as `sums`
        does, and if a summand has no gradient.
        """
        by_parameters = [np.zeros(len(values)) for values in parameters]
        by_columns = tuple(np.empty_like(column) for column in self._columns[:3]) if columns else ()
        given = (ADDRESS * 3)(*map(address, by_columns))
        self._call("pair_gradients", summands, parameters, "by_sums",
                   [np.ascontiguousarray(by, self._kind) for by in by_sums], by_parameters, ctypes.byref(given))
        return by_parameters, by_columns

    def _call(self, name: str, summands: Sequence[Summand], parameters: Sequence[np.ndarray], field: str,
              sums: Sequence[np.ndarray], by_parameters: Sequence[np.ndarray] = (), *more: object) -> None:
        structures, held = (_Given * len(summands))(), []
        for number, (summand, values, columns) in enumerate(zip(summands, parameters, sums)):
            arrays = [np.ascontiguousarray(given, np.float64) for given in (summand.numbers, values, summand.parity)]
            held.append(arrays)
            given = structures[number]
            given.kind, given.scalar = summand.kind.encode(), summand.scalar
            given.numbers_count, given.parameters_count, given.components = map(len, arrays)
            given.numbers, given.parameters, given.parity = map(address, arrays)
            setattr(given, field, address(columns))
            if by_parameters:
                given.by_parameters = address(by_parameters[number])
        function = getattr(library(), f"{name}_{self._kind}")
        function.restype = INT
        result = function(ctypes.byref(self._particles), INT(len(summands)), structures, *more)
        if result != DONE:
            reasons = {UNKNOWN: f"no such summands: {summands}", NO_GRADIENT: f"no gradient of one of {summands}"}
            raise ValueError(f"pairs: {reasons.get(result, f'the position of particle {result} is not finite')}")
