"""The one-dimensional passes of a slab transform, cache-sized blocks at a time, on the kept modes only.

Real fields are transformed two planes at a time, f + i g as one complex plane: complex transforms run at full vector
width, while FFTW's real ones do not: at 128^2 they took 2.5 times as long with measured plans, 5 times with estimated.

FFTW_ESTIMATE throughout: measured plans may differ from run to run, and with them the last bits of the results.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
import pyfftw

BLOCK_BYTES = 2**18  # of one component in a pass: a few of them fit the second-level cache of a core
PADDING = 8           # complex numbers between the lines along x of a plane that is transformed along y


class ColumnPass:
    """Transforms along z of columns (components, z, y, x), `cells` long, with `width` modes along x."""

    def __init__(self, cells: int, width: int, dtype: np.dtype) -> None:
        self.cells, self.width, self.dtype = cells, width, np.dtype(dtype)
        self._plans: dict[tuple[str, int, int], pyfftw.FFTW] = {}

    def rows(self, count: int, components: int) -> list[slice]:
        """The blocks of y, out of `count`, that are transformed together."""
        size = max(1, BLOCK_BYTES // max(1, components * self.cells * self.width * self.dtype.itemsize))
        return [slice(start, min(start + size, count)) for start in range(0, count, size)]

    def plan(self, direction: str, components: int, rows: int) -> pyfftw.FFTW:
        """The plan for a block, with its own arrays; whoever fills the input of "BACKWARD" leaves its gap zero."""
        key = (direction, components, rows)
        if key not in self._plans:
            shape = (components, self.cells, rows, self.width)
            given, result = (pyfftw.zeros_aligned(shape, self.dtype) for _ in range(2))
            self._plans[key] = pyfftw.FFTW(given, result, axes=(1,), direction=f"FFTW_{direction}",
                                           flags=("FFTW_ESTIMATE",))
        return self._plans[key]


class PlanePass:
    """Transforms in (y, x) between real planes (c, planes, y, x) and kept modes, for pairs of planes.

    `pack` turns modes (c, planes, ky, kx >= 0) of real planes into those (c, pairs, ky, kx) of complex ones, f + i g,
    kx = 0 ... K, -K ... -1, f from the first half of the planes and g from the second; `unpack` is its inverse, but
    for a factor of two. An odd plane out has g = 0. Multiplying packed modes by i kx or i ky differentiates both.
    """

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cells, self.cutoff, self.dtype = cells, cutoff, np.dtype(dtype)
        self._passes: dict[tuple[str, int], tuple[np.ndarray, list[pyfftw.FFTW], np.ndarray]] = {}

    def blocks(self, count: int) -> list[slice]:
        """The blocks of planes, out of `count`, that are transformed together."""
        pairs = max(1, BLOCK_BYTES // (self.cells**2 * self.dtype.itemsize))
        return [slice(start, min(start + 2 * pairs, count)) for start in range(0, count, 2 * pairs)]

    def pack(self, modes: np.ndarray) -> np.ndarray:
        """(c, planes, ky, kx >= 0) -> (c, pairs, ky, kx)."""
        K, (components, planes, rows, _) = self.cutoff, modes.shape
        pairs, whole = (planes + 1) // 2, planes // 2
        packed = np.empty((components, pairs, rows, 2 * K + 1), self.dtype)
        f, ig = modes[:, :pairs], modes[:, pairs:] * self.dtype.type(1j)
        if whole < pairs:
            packed[:, whole:, :, : K + 1] = f[:, whole:]
            _mirror(f[:, whole:], packed[:, whole:, :, K + 1 :])
        np.add(f[:, :whole], ig, out=packed[:, :whole, :, : K + 1])
        np.subtract(f[:, :whole], ig, out=ig)
        _mirror(ig, packed[:, :whole, :, K + 1 :])
        # The plane kx = 0 holds both a mode and its mirror image: where they are not conjugate, by round-off, their
        # mean counts, or f would leak into g.
        real = _hermitian(modes[..., 0])
        packed[..., 0] = real[:, :pairs]
        packed[:, :whole, :, 0] += self.dtype.type(1j) * real[:, pairs:]
        return packed

    def unpack(self, packed: np.ndarray, planes: int) -> np.ndarray:
        """(c, pairs, ky, kx) -> twice the modes (c, planes, ky, kx >= 0)."""
        K, (components, pairs, rows, _) = self.cutoff, packed.shape
        whole = planes - pairs
        mirrored = np.empty((components, pairs, rows, K + 1), self.dtype)
        _mirror(packed[..., K:], mirrored[..., 1:])
        np.conjugate(packed[..., :1, 0], out=mirrored[..., :1, 0])
        np.conjugate(packed[..., :0:-1, 0], out=mirrored[..., 1:, 0])
        modes = np.empty((components, planes, rows, K + 1), self.dtype)
        positive = packed[..., : K + 1]
        np.add(positive, mirrored, out=modes[:, :pairs])
        np.subtract(positive[:, :whole], mirrored[:, :whole], out=modes[:, pairs:])
        modes[:, pairs:] *= self.dtype.type(-1j)
        return modes

    def to_physical(self, packed: Sequence[np.ndarray], planes: int, out: np.ndarray) -> None:
        """Real planes of packed modes, given in parts (c_i, pairs, ky, kx): out (sum of c_i, planes, y, x)."""
        pairs = (planes + 1) // 2
        rows, plans, complex_planes = self._pass("BACKWARD", pairs)
        for modes, real in zip(itertools.chain.from_iterable(packed), out):
            for given, place in zip(self._kept(modes), self._kept(rows)):
                place[...] = given
            for plan in plans:
                plan.execute()
            real[:pairs] = complex_planes.real
            real[pairs:] = complex_planes[: planes - pairs].imag

    def to_modes(self, real: np.ndarray) -> np.ndarray:
        """Packed modes (c, pairs, ky, kx), not normalised, of real planes (c, planes, y, x)."""
        width, (components, planes) = 2 * self.cutoff + 1, real.shape[:2]
        pairs = (planes + 1) // 2
        complex_planes, plans, rows = self._pass("FORWARD", pairs)
        packed = np.empty((components, pairs, width, width), self.dtype)
        for values, modes in zip(real, packed):
            complex_planes.real = values[:pairs]
            complex_planes[: planes - pairs].imag = values[pairs:]
            complex_planes[planes - pairs :].imag = 0
            for plan in plans:
                plan.execute()
            for place, result in zip(self._kept(modes), self._kept(rows)):
                place[...] = result
        return packed

    def _kept(self, modes: np.ndarray) -> list[np.ndarray]:
        """The kept modes in the corners of an array (pairs, ky, kx), in which dropped ones may lie between them."""
        K, (_, rows, width) = self.cutoff, modes.shape
        return [modes[:, y, x] for y in (slice(0, K + 1), slice(rows - K, rows))
                for x in (slice(0, K + 1), slice(width - K, width))]

    def _pass(self, direction: str, pairs: int) -> tuple[np.ndarray, list[pyfftw.FFTW], np.ndarray]:
        """Input, plans and output for one component. Gaps of dropped modes stay zero: no plan writes to its input."""
        key = (direction, pairs)
        if key not in self._passes:
            n, K = self.cells, self.cutoff
            # Along y go the columns 0 ... K and -K ... -1, from one whole vector up to another where there is room: the
            # rest of a vector costs as much as several whole ones.
            vector = 32 // self.dtype.itemsize
            stop, start = K + 1 + -(K + 1) % vector, n - K - (n - K) % vector
            if stop > start:
                stop, start = K + 1, n - K
            rows = pyfftw.zeros_aligned((pairs, n, stop + n - start), self.dtype)
            planes = pyfftw.zeros_aligned((pairs, n, n), self.dtype)
            # Lines a power of two apart would all fall into the same few sets of a cache, and push each other out.
            lines = pyfftw.zeros_aligned((pairs, n, n + PADDING), self.dtype)[..., :n]
            kept = [(rows[..., :stop], lines[..., :stop]), (rows[..., stop:], lines[..., start:])]
            settings = {"direction": f"FFTW_{direction}", "flags": ("FFTW_ESTIMATE",)}
            if direction == "BACKWARD":
                plans = [pyfftw.FFTW(a, b, axes=(1,), **settings) for a, b in kept if a.size]
                self._passes[key] = rows, [*plans, pyfftw.FFTW(lines, planes, axes=(2,), **settings)], planes
            else:
                plans = [pyfftw.FFTW(b, a, axes=(1,), **settings) for a, b in kept if a.size]
                self._passes[key] = planes, [pyfftw.FFTW(planes, lines, axes=(2,), **settings), *plans], rows
        return self._passes[key]


def _hermitian(modes: np.ndarray) -> np.ndarray:
    """The modes (..., ky) of the real part of a line."""
    half = modes * modes.real.dtype.type(0.5)
    result = half.copy()
    result[..., 0] += half[..., 0].conj()
    result[..., 1:] += half[..., :0:-1].conj()
    return result


def _mirror(modes: np.ndarray, out: np.ndarray) -> None:
    """Conjugates of modes (..., ky, 0 ... K) at (-ky, -kx), kx = K ... 1: out (..., ky, K)."""
    np.conjugate(modes[..., :1, :0:-1], out=out[..., :1, :])
    np.conjugate(modes[..., :0:-1, :0:-1], out=out[..., 1:, :])
