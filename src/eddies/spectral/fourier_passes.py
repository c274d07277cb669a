"""One-dimensional passes of a slab transform, in blocks that fit the cache, on the kept modes only.

Two planes f and g of a real field, a pair, are transformed together as one complex plane f + i g, because FFTW's
complex transforms run at full vector width. FFTW's real transforms took 2.5 times as long at 128^2 points with measured
plans, and 5 times as long with estimated plans. Packed modes (fields, pairs, ky, kx) are the kept modes of f + i g.

All plans use FFTW_ESTIMATE. Measured plans may differ from run to run, and with them the last bits of the results.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from eddies.cores import threads
from eddies.kernels.copies import Blocks, ColumnCopies, Described, PlaneCopies
from eddies.kernels.library import import_pyfftw

pyfftw = import_pyfftw()

BLOCK_BYTES = 2**18  # size of a block per component and thread: a few blocks fit the second-level cache of a core
CACHE_LINE = 64
# Numbers whose distance in memory is a multiple of this many bytes share few sets of a cache and evict each other. A
# transform of 48 such numbers takes twelve times as long as usual, and a transform of 192 four times as long.
CROWDED = 512

#: Packed modes (fields, pairs, ky, kx), or a tuple (factors, packed modes) that stands for the product of the two. The
#: factors are (1, 1, ky, 1) or (1, 1, 1, kx).
Part = np.ndarray | tuple[np.ndarray, np.ndarray]


class ColumnPlan(NamedTuple):
    """Plan of a transform along z, with its input `given` and its output `result`, both (z, rows, x)."""

    plan: pyfftw.FFTW
    given: Described
    result: Described


class ColumnPass:
    """Transforms of one component along z. Columns (z, y, x) have `cells` points in z and cutoff + 1 modes along x."""

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cells, self.width, self.dtype = cells, cutoff + 1, np.dtype(dtype)
        self.copies = ColumnCopies(cells, cutoff, self.dtype)
        self._plans: dict[tuple[str, int], ColumnPlan] = {}

    def rows(self, count: int) -> list[slice]:
        """Return slices that divide `count` rows along y into the blocks that are transformed together."""
        size = max(1, threads() * BLOCK_BYTES // (self.cells * self.width * self.dtype.itemsize))
        return [slice(start, min(start + size, count)) for start in range(0, count, size)]

    def plan(self, direction: str, rows: slice) -> ColumnPlan:
        """Return the plan for a block of rows in a `direction`, "FORWARD" or "BACKWARD".

        The dropped modes in the input of "BACKWARD" must stay zero.
        """
        key = (direction, rows.stop - rows.start)
        if key not in self._plans:
            given, result = (self._zeros(key[1]) for _ in range(2))
            plan = _plan(given, result, 0, direction)
            self._plans[key] = ColumnPlan(plan, *(Described(column, gaps=True) for column in (given, result)))
        return self._plans[key]

    def _zeros(self, rows: int) -> np.ndarray:
        count = rows * self.width
        memory = pyfftw.zeros_aligned((self.cells, count + _gap(count, self.dtype)), self.dtype)
        return memory[:, :count].reshape(self.cells, rows, self.width)


class PlanePlans(NamedTuple):
    """Plans for pairs of planes, and the memory on which they work.

    `rows` (pairs, y, kx) is transformed along y. All fields use it, one after the other. If it is the input, its
    dropped modes stay zero, because no plan writes to its input. `planes` holds the complex planes (pairs, y, x) of
    each field. `values` (fields, pairs, y, 2 x) shows the same memory as real numbers, with the values of the two
    planes at a point side by side. `plans` lists the plans of each field in order of execution.
    """

    rows: Described
    planes: list[Described]
    values: np.ndarray
    plans: list[list[pyfftw.FFTW]]


class PlanePass:
    """Transforms in (y, x) between pairs of real planes and their packed modes.

    Multiplication of packed modes by i kx or i ky differentiates both planes of a pair.
    """

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cells, self.cutoff, self.dtype = cells, cutoff, np.dtype(dtype)
        self.copies = PlaneCopies(cells, cutoff, self.dtype)
        self._plans: dict[tuple[str, int, int], PlanePlans] = {}

    def blocks(self, count: int) -> list[slice]:
        """Return slices that divide `count` planes into the blocks that are transformed together.

        A block has an even number of planes. If `count` is odd, the last block has only one plane.
        """
        size, even = 2 * max(1, threads() * BLOCK_BYTES // (self.cells**2 * self.dtype.itemsize)), count - count % 2
        blocks = [slice(start, min(start + size, even)) for start in range(0, even, size)]
        return blocks if even == count else [*blocks, slice(even, count)]

    def to_physical(self, packed: Sequence[Part], fields: int, planes: slice) -> PlanePlans:
        """Transform packed modes to a block of planes, and return the plans whose memory then holds the planes.

        `packed` gives the modes of `fields` fields in parts, each of which has the modes of one or more fields.
        """
        plans = self.plans("BACKWARD", fields, planes)
        parts = (part if isinstance(part, tuple) else (None, part) for part in packed)
        filled = itertools.chain.from_iterable(self.copies.filled(part, factors, plans.rows) for factors, part in parts)
        for of_field, _ in zip(plans.plans, filled):
            for plan in of_field:
                plan.execute()
        return plans

    def to_modes(self, plans: PlanePlans, blocks: Blocks, component: int, planes: slice) -> None:
        """Transform the planes in the memory of `plans`, and store their unnormalised modes, times 2, in `blocks`.

        The first field becomes component number `component`, and the other fields become the components after it.
        """
        for number, of_field in enumerate(plans.plans, component):
            for plan in of_field:
                plan.execute()
            self.copies.unpack(plans.rows, blocks, number, planes)

    def plans(self, direction: str, fields: int, planes: slice) -> PlanePlans:
        """Return the plans for `fields` fields on a block of planes. Blocks of equal size share plans and memory."""
        key = (direction, fields, (planes.stop - planes.start + 1) // 2)
        if key not in self._plans:
            self._plans[key] = self._planned(*key)
        return self._plans[key]

    def _planned(self, direction: str, fields: int, pairs: int) -> PlanePlans:
        n, K = self.cells, self.cutoff
        # Only the columns kx = 0 ... K and -K ... -1 are transformed along y. Both ranges are widened to whole vectors
        # if there is room, because a partial vector costs as much as several whole ones.
        vector = 32 // self.dtype.itemsize
        stop, start = K + 1 + -(K + 1) % vector, n - K - (n - K) % vector
        if stop > start:
            stop, start = K + 1, n - K
        # The padding of each row (see `_gap`) lies where the dropped modes are.
        width = stop + n - start
        width += _gap(width, self.dtype)
        rows = pyfftw.zeros_aligned((pairs, n, width), self.dtype)
        lines = pyfftw.zeros_aligned((pairs, n, n + _gap(n, self.dtype)), self.dtype)[..., :n]
        values = self._values(fields, pairs)
        planes = [field.view(self.dtype) for field in values]
        kept = [(rows[..., :stop], lines[..., :stop]), (rows[..., width - n + start :], lines[..., start:])]
        kept = [pair for pair in kept if pair[0].size]
        if direction == "BACKWARD":
            along_y = [_plan(a, b, 1, direction) for a, b in kept]
            plans = [[*along_y, _plan(lines, field, 2, direction)] for field in planes]
        else:
            along_y = [_plan(b, a, 1, direction) for a, b in kept]
            plans = [[_plan(field, lines, 2, direction), *along_y] for field in planes]
        return PlanePlans(Described(rows), list(map(Described, planes)), values, plans)

    def _values(self, fields: int, pairs: int) -> np.ndarray:
        """Return zeros (fields, pairs, y, 2 x). Successive fields begin an odd number of cache lines apart.

        Otherwise the values of many fields at one point would share a few sets of a cache.
        """
        n, item = self.cells, self.dtype.itemsize
        apart = (-(-pairs * n * n * item // CACHE_LINE) | 1) * CACHE_LINE
        memory = pyfftw.zeros_aligned(fields * apart, np.uint8, n=CACHE_LINE)
        real = np.zeros(1, self.dtype).real.dtype
        return np.ndarray((fields, pairs, n, 2 * n), real, memory, strides=(apart, n * n * item, n * item, item // 2))


def _gap(count: int, dtype: np.dtype) -> int:
    """Return how many unused numbers must follow a line of `count` numbers.

    Without them, transforms across lines would use only a few sets of a cache.
    """
    return 0 if count * dtype.itemsize % CROWDED else CACHE_LINE // dtype.itemsize


def _plan(given: np.ndarray, result: np.ndarray, axis: int, direction: str) -> pyfftw.FFTW:
    return pyfftw.FFTW(given, result, axes=(axis,), direction=f"FFTW_{direction}", flags=("FFTW_ESTIMATE",),
                       threads=threads())
