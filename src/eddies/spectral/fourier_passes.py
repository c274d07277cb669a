"""The one-dimensional passes of a slab transform, cache-sized blocks at a time, on the kept modes only.

Real fields are transformed two planes at a time, f + i g as one complex plane: complex transforms run at full vector
width, while FFTW's real ones do not: at 128^2 they took 2.5 times as long with measured plans, 5 times with estimated.

FFTW_ESTIMATE throughout: measured plans may differ from run to run, and with them the last bits of the results.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyfftw

from eddies.kernels.copies import ColumnCopies, PlaneCopies
from eddies.cores import threads
from eddies.kernels.library import library

BLOCK_BYTES = 2**18  # of one component and thread in a pass: a few of them fit the second-level cache of a core
CACHE_LINE = 64
# Numbers of one transform so many bytes apart, or a multiple, fall into few sets of a cache and push each other out:
# with 48 of them it takes twelve times as long, with 192 four times.
CROWDED = 512

#: Packed modes (c, pairs, ky, kx), or these and factors (1, 1, ky, 1) or (1, 1, 1, kx) by which they are multiplied.
Part = np.ndarray | tuple[np.ndarray, np.ndarray]


class ColumnPass:
    """Transforms along z of columns (z, y, x) of one component, `cells` long, with `width` modes along x."""

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cells, self.width, self.dtype = cells, cutoff + 1, np.dtype(dtype)
        self.copies = ColumnCopies(library(), cells, cutoff, self.dtype)
        self._plans: dict[tuple[str, int], ColumnPlan] = {}

    def rows(self, count: int) -> list[slice]:
        """The blocks of y, out of `count`, that are transformed together."""
        size = max(1, threads() * BLOCK_BYTES // (self.cells * self.width * self.dtype.itemsize))
        return [slice(start, min(start + size, count)) for start in range(0, count, size)]

    def plan(self, direction: str, rows: slice) -> ColumnPlan:
        """The plan for a block; whoever fills the input of "BACKWARD" leaves its gap zero."""
        key = (direction, rows.stop - rows.start)
        if key not in self._plans:
            given, result = (self._zeros(key[1]) for _ in range(2))
            plan = _plan(given, result, 0, direction)
            self._plans[key] = ColumnPlan(plan, *map(self.copies.described_column, (given, result)))
        return self._plans[key]

    def _zeros(self, rows: int) -> np.ndarray:
        count = rows * self.width
        memory = pyfftw.zeros_aligned((self.cells, count + _gap(count, self.dtype)), self.dtype)
        return memory[:, :count].reshape(self.cells, rows, self.width)


@dataclass(frozen=True)
class ColumnPlan:
    """A plan and its arrays (z, rows, x), as `ColumnPass.copies` want them."""

    plan: pyfftw.FFTW
    given: Any
    result: Any


@dataclass(frozen=True)
class PlanePlans:
    """Plans for pairs of planes, one field after the other.

    `rows` (pairs, y, kx), transformed along y, are used for all fields in turn; gaps of dropped modes stay zero, as no
    plan writes to its input. `planes` are the complex planes (pairs, y, x) of each field, both as `PlanePass.copies`
    want them, and `values` (fields, pairs, y, 2 x) the same planes as real numbers: those of a point of the first and
    of the second plane of a pair side by side.
    """

    rows: Any
    planes: list[Any]
    values: np.ndarray
    plans: list[list[pyfftw.FFTW]]


class PlanePass:
    """Transforms in (y, x) between real planes and kept modes, for pairs of planes; `copies` tell how these are packed.

    Multiplying packed modes by i kx or i ky differentiates both planes of a pair.
    """

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cells, self.cutoff, self.dtype = cells, cutoff, np.dtype(dtype)
        self.copies = PlaneCopies(library(), cells, cutoff, self.dtype)
        self._plans: dict[tuple[str, int, int], PlanePlans] = {}

    def blocks(self, count: int) -> list[slice]:
        """The blocks of planes, out of `count`, that are transformed together: even numbers, and an odd one alone."""
        size, even = 2 * max(1, threads() * BLOCK_BYTES // (self.cells**2 * self.dtype.itemsize)), count - count % 2
        blocks = [slice(start, min(start + size, even)) for start in range(0, even, size)]
        return blocks if even == count else [*blocks, slice(even, count)]

    def to_physical(self, packed: Sequence[Part], fields: int, pairs: int) -> PlanePlans:
        """Transform packed modes of pairs of planes, given in parts, to the planes of so many fields."""
        plans = self.plans("BACKWARD", fields, pairs)
        parts = (part if isinstance(part, tuple) else (None, part) for part in packed)
        filled = itertools.chain.from_iterable(self.copies.filled(part, factors, plans.rows) for factors, part in parts)
        for of_field, _ in zip(plans.plans, filled):
            for plan in of_field:
                plan.execute()
        return plans

    def to_modes(self, plans: PlanePlans, blocks: Any, component: int, planes: slice) -> None:
        """Transform the planes of fields to twice the modes, not normalised, of components of blocks from a first one
        on, these `described` by the copies."""
        for number, of_field in enumerate(plans.plans, component):
            for plan in of_field:
                plan.execute()
            self.copies.unpack(plans.rows, blocks, number, planes)

    def plans(self, direction: str, fields: int, pairs: int) -> PlanePlans:
        """Plans for so many fields, and the memory that they use whenever they are asked for."""
        key = (direction, fields, pairs)
        if key not in self._plans:
            self._plans[key] = self._planned(*key)
        return self._plans[key]

    def _planned(self, direction: str, fields: int, pairs: int) -> PlanePlans:
        n, K = self.cells, self.cutoff
        # Along y go the columns 0 ... K and -K ... -1, from one whole vector up to another where there is room: the
        # rest of a vector costs as much as several whole ones.
        vector = 32 // self.dtype.itemsize
        stop, start = K + 1 + -(K + 1) % vector, n - K - (n - K) % vector
        if stop > start:
            stop, start = K + 1, n - K
        # What keeps rows apart is in their gap, where dropped modes are.
        width = stop + n - start
        width += _gap(width, self.dtype)
        rows = pyfftw.zeros_aligned((pairs, n, width), self.dtype)
        lines = pyfftw.zeros_aligned((pairs, n, n + _gap(n, self.dtype)), self.dtype)[..., :n]
        values = self._values(fields, pairs)
        planes = [field.view(self.dtype) for field in values]
        kept = [(rows[..., :stop], lines[..., :stop]), (rows[..., width - n + start :], lines[..., start:])]
        if direction == "BACKWARD":
            along_y = [_plan(a, b, 1, direction) for a, b in kept if a.size]
            plans = [[*along_y, _plan(lines, field, 2, direction)] for field in planes]
        else:
            along_y = [_plan(b, a, 1, direction) for a, b in kept if a.size]
            plans = [[_plan(field, lines, 2, direction), *along_y] for field in planes]
        described = self.copies.described
        return PlanePlans(described(rows), [described(field) for field in planes], values, plans)

    def _values(self, fields: int, pairs: int) -> np.ndarray:
        """Zeros (fields, pairs, y, 2 x), fields an odd number of cache lines apart: a loop over the points of many of
        them would otherwise find them all in the same few sets of a cache."""
        n, item = self.cells, self.dtype.itemsize
        apart = (-(-pairs * n * n * item // CACHE_LINE) | 1) * CACHE_LINE
        memory = pyfftw.zeros_aligned(fields * apart, np.uint8, n=CACHE_LINE)
        real = np.zeros(1, self.dtype).real.dtype
        return np.ndarray((fields, pairs, n, 2 * n), real, memory, strides=(apart, n * n * item, n * item, item // 2))


def _gap(count: int, dtype: np.dtype) -> int:
    """Numbers to leave between lines of so many, which are transformed across, for the cache's sake."""
    return 0 if count * dtype.itemsize % CROWDED else CACHE_LINE // dtype.itemsize


def _plan(given: np.ndarray, result: np.ndarray, axis: int, direction: str) -> pyfftw.FFTW:
    return pyfftw.FFTW(given, result, axes=(axis,), direction=f"FFTW_{direction}", flags=("FFTW_ESTIMATE",),
                       threads=threads())
