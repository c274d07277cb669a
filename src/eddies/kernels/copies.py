"""What is copied around the one-dimensional passes of a slab transform, by the compiled library.

Of an axis of `cells` a transform keeps the modes 0 ... K, -K ... -1, which stand at the ends of its arrays; what lies
between them is a gap that stays zero. Arrays are `described` once, as they are used many times; contiguous ones of the
given precision are needed, ValueError otherwise.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence

import numpy as np

INT, ADDRESS, NUMBER = ctypes.c_int64, ctypes.c_void_p, ctypes.c_double


class _Blocks(ctypes.Structure):
    """Blocks (components, planes, lines, width) as copies.cpp wants them, which follow each other along planes or lines
    (axis 1 or 2)."""

    _fields_ = ([(name, INT) for name in ("ranks", "planes", "lines", "width")]
                + [(name, ADDRESS) for name in ("addresses", "starts")])

    def __init__(self, blocks: Sequence[np.ndarray], axis: int, dtype: np.dtype) -> None:
        counts = [block.shape[axis] for block in blocks]
        shape = list(blocks[0].shape)
        for block, shape[axis] in zip(blocks, counts):
            _require(block, tuple(shape), dtype)
        shape[axis] = sum(counts)
        self.components, self.shape = shape[0], tuple(shape[1:])
        self._kept = blocks, np.array([block.ctypes.data for block in blocks], np.uint64), np.cumsum([0, *counts])
        super().__init__(len(blocks), *self.shape, *(array.ctypes.data for array in self._kept[1:]))


class _Array:
    """A contiguous array and its address, which numpy takes long to tell."""

    def __init__(self, array: np.ndarray) -> None:
        _require(array, array.shape, array.dtype)
        self.array, self.address, self.dtype = array, array.ctypes.data, array.dtype
        self.shape, self.strides = array.shape, array.strides

    def require(self, shape: tuple[int, ...], dtype: np.dtype) -> None:
        """ValueError where it is another array."""
        if self.shape != shape or self.dtype != dtype:
            _require(self.array, shape, dtype)


class _Column(_Array):
    """A column (z, rows, x), contiguous but for what lies between the numbers of one z and those of the next."""

    def __init__(self, array: np.ndarray) -> None:
        super().__init__(array[0])
        self.shape, self.apart = array.shape, array.strides[0] // array.itemsize

    def require(self, shape: tuple[int, ...], dtype: np.dtype) -> None:
        """ValueError where it is another column."""
        if self.shape != shape or self.dtype != dtype:
            raise ValueError(f"a column {self.dtype} {self.shape}: {dtype} {shape} is needed")


class ColumnCopies:
    """Copies between modes (c, kz, y, x), columns (z, rows, x) of one component that are transformed along z, and the
    blocks (c, z, y, x) of columns that ranks exchange, which follow each other in z. `rows` are those of y in a column,
    which is contiguous but for what may lie between one z and the next.
    """

    def __init__(self, library: ctypes.CDLL, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self._cells, self._cutoff, self._dtype = cells, cutoff, np.dtype(dtype)
        self._fill = _function(library, "fill_column", self._dtype, *5 * [INT], *3 * [ADDRESS])
        self._store = _function(library, "store_column", self._dtype, *5 * [INT], ADDRESS, NUMBER, ADDRESS)
        self._send, self._receive = (_function(library, name, self._dtype, ADDRESS, *4 * [INT], ADDRESS)
                                     for name in ("send_column", "receive_column"))

    def described_blocks(self, blocks: Sequence[np.ndarray]) -> _Blocks:
        """Blocks as the other methods want them."""
        return _Blocks(blocks, 1, self._dtype)

    def described_column(self, column: np.ndarray) -> _Column:
        """A column as the other methods want it."""
        return _Column(column)

    def described(self, array: np.ndarray) -> _Array:
        """Any other array as the other methods want it."""
        return _Array(array)

    def fill(self, modes: _Array, component: int, rows: slice, factors: _Array | None, column: _Column) -> None:
        """Modes, times factors (kz) if there are any, to a column."""
        sizes, start = self._place(modes, component, rows, column)
        if factors is not None:
            factors.require(modes.shape[1:2], self._dtype)
        self._fill(*sizes, start, None if factors is None else factors.address, column.address)

    def store(self, column: _Column, scale: float, modes: _Array, component: int, rows: slice) -> None:
        """A column times a number to modes."""
        sizes, start = self._place(modes, component, rows, column)
        self._store(*sizes, column.address, scale, start)

    def send(self, column: _Column, blocks: _Blocks, component: int, rows: slice) -> None:
        """A column to blocks."""
        self._exchange(self._send, column, blocks, component, rows)

    def receive(self, blocks: _Blocks, component: int, rows: slice, column: _Column) -> None:
        """Blocks to a column."""
        self._exchange(self._receive, column, blocks, component, rows)

    def _place(self, modes: _Array, component: int, rows: slice, column: _Column) -> tuple[tuple[int, ...], int]:
        """The sizes that the library wants, and where the rows of the modes begin."""
        components, kept, lines, width = modes.shape
        modes.require((components, 2 * self._cutoff + 1, lines, width), self._dtype)
        column.require((self._cells, rows.stop - rows.start, width), self._dtype)
        _within(rows.start, rows.stop, lines)
        _within(component, component + 1, components)
        start = modes.address + component * modes.strides[0] + rows.start * modes.strides[2]
        return (self._cutoff, self._cells, lines * width, column.shape[1] * width, column.apart), start

    def _exchange(self, function: Callable[..., None], column: _Column, blocks: _Blocks, component: int,
                  rows: slice) -> None:
        planes, lines, width = blocks.shape
        column.require((planes, rows.stop - rows.start, width), self._dtype)
        _within(rows.start, rows.stop, lines)
        _within(component, component + 1, blocks.components)
        function(ctypes.byref(blocks), component, rows.start, rows.stop - rows.start, column.apart, column.address)


class PlaneCopies:
    """Copies between modes of planes in blocks (c, planes, y, x), kx >= 0, that ranks exchange and that follow each
    other in y, packed modes (c, pairs, ky, kx), and the arrays of transforms.

    Two real planes f and g, one half of a block of planes apart, are transformed as one complex plane f + i g, of which
    packed modes hold kx = 0 ... K, -K ... -1. Planes are an even number, or a single one, which is its own partner.
    Where modes of kx = 0 and their mirror images are not conjugate, by round-off, their mean counts.
    """

    def __init__(self, library: ctypes.CDLL, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self._cells, self._cutoff, self._kept, self._dtype = cells, cutoff, 2 * cutoff + 1, np.dtype(dtype)
        self._real = np.zeros(1, self._dtype).real.dtype
        self._pack = _function(library, "pack", self._dtype, ADDRESS, *3 * [INT], ADDRESS)
        self._unpack = _function(library, "unpack", self._dtype, ADDRESS, *5 * [INT], ADDRESS)
        self._fill = _function(library, "fill", self._dtype, *4 * [INT], *4 * [ADDRESS])
        self._split, self._join = (_function(library, name, self._dtype, INT, *3 * [ADDRESS])
                                   for name in ("split", "join"))

    def described_blocks(self, blocks: Sequence[np.ndarray]) -> _Blocks:
        """Blocks as the other methods want them."""
        return _Blocks(blocks, 2, self._dtype)

    def described(self, array: np.ndarray) -> _Array:
        """Any other array as the other methods want it."""
        return _Array(array)

    def pack(self, blocks: _Blocks, planes: slice) -> np.ndarray:
        """Packed modes of some planes."""
        pairs = self._pairs(blocks, planes)
        packed = np.empty((blocks.components, pairs, self._kept, self._kept), self._dtype)
        self._pack(ctypes.byref(blocks), blocks.components, planes.start, planes.stop - planes.start, _address(packed))
        return packed

    def filled(self, part: np.ndarray, factors: np.ndarray | None, rows: _Array) -> Iterator[None]:
        """Copy packed modes of components, one after the other, times factors (1, 1, ky or 1, kx or 1) if there are
        any, to `rows` (pairs, y, x), which are transformed along y."""
        part, (pairs, _, width) = np.ascontiguousarray(part, self._dtype), rows.shape
        _require(part, (len(part), pairs, self._kept, self._kept), self._dtype)
        rows.require((pairs, self._cells, width), self._dtype)
        by_y = by_x = None
        if factors is not None:
            along_x = factors.shape[-1] > 1
            _require(factors, (1, 1, 1, self._kept) if along_x else (1, 1, self._kept, 1), self._dtype)
            by_y, by_x = (None, _address(factors)) if along_x else (_address(factors), None)
        given = _address(part)
        for component in range(len(part)):
            self._fill(pairs, self._cutoff, self._cells, width, given + component * part.strides[0], by_y, by_x,
                       rows.address)
            yield

    def unpack(self, rows: _Array, blocks: _Blocks, component: int, planes: slice) -> None:
        """Twice the modes of some planes, to one component of blocks, of what has been transformed along y."""
        pairs, width = self._pairs(blocks, planes), rows.shape[-1]
        rows.require((pairs, self._cells, width), self._dtype)
        _within(component, component + 1, blocks.components)
        self._unpack(ctypes.byref(blocks), component, planes.start, planes.stop - planes.start, self._cells, width,
                     rows.address)

    def split(self, complex_planes: _Array, real: _Array, component: int, planes: slice) -> None:
        """Complex planes (pairs, y, x) to some real ones of fields (c, planes, y, x)."""
        self._split(*self._halves(complex_planes, real, component, planes))

    def join(self, real: _Array, component: int, planes: slice, complex_planes: _Array) -> None:
        """Some real planes of fields (c, planes, y, x) to complex ones (pairs, y, x)."""
        points, place, f, g = self._halves(complex_planes, real, component, planes)
        self._join(points, f, g, place)

    def _pairs(self, blocks: _Blocks, planes: slice) -> int:
        _within(planes.start, planes.stop, blocks.shape[0])
        if blocks.shape[1:] != (self._kept, self._cutoff + 1):
            raise ValueError(f"blocks of {blocks.shape} modes: (planes, {self._kept}, {self._cutoff + 1}) are needed")
        return _pairs_of(planes)

    def _halves(self, complex_planes: _Array, real: _Array, component: int, planes: slice) -> tuple[int, ...]:
        """Points, and the addresses of complex planes and of the first and the second half of real ones."""
        pairs, (components, count, y, x) = _pairs_of(planes), real.shape
        complex_planes.require((pairs, y, x), self._dtype)
        real.require((components, count, y, x), self._real)
        _within(planes.start, planes.stop, count)
        _within(component, component + 1, components)
        f = real.address + component * real.strides[0] + planes.start * real.strides[1]
        return pairs * y * x, complex_planes.address, f, f + (planes.stop - planes.start - pairs) * real.strides[1]


def _pairs_of(planes: slice) -> int:
    count = planes.stop - planes.start
    if count != 1 and count % 2:
        raise ValueError(f"{count} planes: an even number of them, or a single one, are needed")
    return (count + 1) // 2


def _function(library: ctypes.CDLL, name: str, dtype: np.dtype, *arguments: type) -> Callable[..., None]:
    """The function of the library for a precision."""
    function = getattr(library, f"copies_{name}_{'float64' if dtype == np.complex128 else 'float32'}")
    function.argtypes, function.restype = arguments, None
    return function


def _address(array: np.ndarray) -> int:
    # Three times as fast as array.ctypes.data, of which there are some for every block of planes.
    return ctypes.addressof(ctypes.c_char.from_buffer(array))


def _require(array: np.ndarray, shape: tuple[int, ...], dtype: np.dtype) -> None:
    if array.shape != shape or array.dtype != dtype or not array.flags.c_contiguous:
        raise ValueError(f"{array.dtype} {array.shape}: contiguous {dtype} {shape} are needed")


def _within(start: int, stop: int, size: int) -> None:
    if not 0 <= start < stop <= size:
        raise ValueError(f"{start} to {stop} of {size}")
