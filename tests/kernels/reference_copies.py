"""What `eddies.kernels.copies` copies, by numpy: classes with the same methods."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

Blocks = Sequence[np.ndarray]


class ColumnCopies:
    """Copies around transforms along z."""

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        K = cutoff
        self.kept = ((slice(0, K + 1), slice(0, K + 1)), (slice(K + 1, None), slice(cells - K, None)))

    def described_blocks(self, blocks: Blocks) -> Blocks:
        """Blocks as the other methods want them."""
        return blocks

    def described_column(self, column: np.ndarray) -> np.ndarray:
        """A column as the other methods want it."""
        return column

    def described(self, array: np.ndarray) -> np.ndarray:
        """Any other array as the other methods want it."""
        return array

    def fill(self, modes: np.ndarray, component: int, rows: slice, factors: np.ndarray | None,
             column: np.ndarray) -> None:
        """Modes, times factors (kz) if there are any, to a column."""
        for kept, place in self.kept:
            given = modes[component, kept, rows]
            column[place] = given if factors is None else given * factors[kept, None, None]

    def store(self, column: np.ndarray, scale: float, modes: np.ndarray, component: int, rows: slice) -> None:
        """A column times a number to modes."""
        for kept, place in self.kept:
            np.multiply(column[place], modes.real.dtype.type(scale), out=modes[component, kept, rows])

    def send(self, column: np.ndarray, blocks: Blocks, component: int, rows: slice) -> None:
        """A column to blocks."""
        start = 0
        for block in blocks:
            block[component, :, rows] = column[start : start + block.shape[1]]
            start += block.shape[1]

    def receive(self, blocks: Blocks, component: int, rows: slice, column: np.ndarray) -> None:
        """Blocks to a column."""
        np.concatenate([block[component, :, rows] for block in blocks], out=column)


class PlaneCopies:
    """Copies around transforms in planes."""

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self.cutoff, self.dtype = cutoff, np.dtype(dtype)

    def described_blocks(self, blocks: Blocks) -> Blocks:
        """Blocks as the other methods want them."""
        return blocks

    def described(self, array: np.ndarray) -> np.ndarray:
        """Any other array as the other methods want it."""
        return array

    def pack(self, blocks: Blocks, planes: slice) -> np.ndarray:
        """Packed modes of some planes."""
        modes = np.concatenate([block[:, planes] for block in blocks], axis=2)
        K, (components, count, rows, _) = self.cutoff, modes.shape
        pairs = (count + 1) // 2
        # The plane kx = 0 holds both a mode and its mirror image: where they are not conjugate, by round-off, their
        # mean counts, or f would leak into g.
        modes[..., 0] = (modes[..., 0] + _mirrored(modes[..., :1])[..., 0]) / 2
        f, ig = modes[:, :pairs], modes[:, count - pairs :] * self.dtype.type(1j)
        packed = np.empty((components, pairs, rows, 2 * K + 1), self.dtype)
        packed[..., : K + 1] = f + ig
        packed[..., K + 1 :] = _mirrored((f - ig)[..., :0:-1])
        return packed

    def filled(self, part: np.ndarray, factors: np.ndarray | None, rows: np.ndarray) -> Iterator[None]:
        """Copy packed modes of components, one after the other, times factors (1, 1, ky or 1, kx or 1) if there are
        any, to `rows` (pairs, y, x), which are transformed along y."""
        for modes in part if factors is None else part * factors:
            for kept, place in zip(self._kept(modes), self._kept(rows)):
                place[...] = kept
            yield

    def unpack(self, rows: np.ndarray, blocks: Blocks, component: int, planes: slice) -> None:
        """Twice the modes of some planes, to one component of blocks, of what has been transformed along y."""
        K = self.cutoff
        packed = np.empty((len(rows), 2 * K + 1, 2 * K + 1), self.dtype)
        for place, kept in zip(self._kept(packed), self._kept(rows)):
            place[...] = kept
        positive, negative = packed[..., : K + 1], np.concatenate([packed[..., :1], packed[..., :K:-1]], axis=2)
        mirrored = _mirrored(negative)
        modes = np.concatenate([positive + mirrored, (positive - mirrored) * self.dtype.type(-1j)])
        start = 0
        for block in blocks:
            block[component, planes] = modes[: planes.stop - planes.start, start : start + block.shape[2]]
            start += block.shape[2]

    def split(self, complex_planes: np.ndarray, real: np.ndarray, component: int, planes: slice) -> None:
        """Complex planes (pairs, y, x) to some real ones of fields (c, planes, y, x)."""
        pairs, real = len(complex_planes), real[component, planes]
        real[:pairs], real[pairs:] = complex_planes.real, complex_planes[: len(real) - pairs].imag

    def join(self, real: np.ndarray, component: int, planes: slice, complex_planes: np.ndarray) -> None:
        """Some real planes of fields (c, planes, y, x) to complex ones (pairs, y, x)."""
        pairs, real = len(complex_planes), real[component, planes]
        complex_planes.real, complex_planes.imag = real[:pairs], real[-pairs:]

    def _kept(self, modes: np.ndarray) -> list[np.ndarray]:
        """The kept modes in the corners of an array (pairs, ky, kx)."""
        K, (_, rows, width) = self.cutoff, modes.shape
        return [modes[:, y, x] for y in (slice(0, K + 1), slice(rows - K, rows))
                for x in (slice(0, K + 1), slice(width - K, width))]


def _mirrored(modes: np.ndarray) -> np.ndarray:
    """Conjugates of modes (..., ky, x) at -ky."""
    return np.concatenate([modes[..., :1, :], modes[..., :0:-1, :]], axis=-2).conj()
