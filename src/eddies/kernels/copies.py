"""What is copied around the one-dimensional passes of a slab transform, by the compiled library."""

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


class CompiledColumnCopies:
    """Copies around transforms along z: see `eddies.spectral.copies.ColumnCopies`, which is the definition and has the
    same methods. Arrays that lie as they do there, contiguous and of its precision, are needed: ValueError otherwise.
    """

    def __init__(self, library: ctypes.CDLL, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self._sizes, self._kept, self._dtype = (cutoff, cells), 2 * cutoff + 1, np.dtype(dtype)
        self._fill = _function(library, "fill_column", self._dtype, *4 * [INT], *3 * [ADDRESS])
        self._store = _function(library, "store_column", self._dtype, *4 * [INT], ADDRESS, NUMBER, ADDRESS)
        self._send, self._receive = (_function(library, name, self._dtype, ADDRESS, *3 * [INT], ADDRESS)
                                     for name in ("send_column", "receive_column"))

    def described(self, blocks: Sequence[np.ndarray]) -> _Blocks:
        """Blocks as the other methods want them."""
        return _Blocks(blocks, 1, self._dtype)

    def fill(self, modes: np.ndarray, rows: slice, factors: np.ndarray | None, column: np.ndarray) -> None:
        """Modes of one component, times factors (kz) if there are any, to a column."""
        sizes, start = self._checked(modes, rows, column)
        if factors is not None:
            _require(factors, (self._kept,), self._dtype)
        self._fill(*sizes, start, None if factors is None else _address(factors), _address(column))

    def store(self, column: np.ndarray, scale: float, modes: np.ndarray, rows: slice) -> None:
        """A column times a number to modes of one component."""
        sizes, start = self._checked(modes, rows, column)
        self._store(*sizes, _address(column), scale, start)

    def send(self, column: np.ndarray, blocks: _Blocks, component: int, rows: slice) -> None:
        """A column to blocks."""
        self._exchange(self._send, column, blocks, component, rows)

    def receive(self, blocks: _Blocks, component: int, rows: slice, column: np.ndarray) -> None:
        """Blocks to a column."""
        self._exchange(self._receive, column, blocks, component, rows)

    def _checked(self, modes: np.ndarray, rows: slice, column: np.ndarray) -> tuple[tuple[int, ...], int]:
        """The sizes that the library wants, and where the rows of the modes begin."""
        (_, lines, width), count = modes.shape, rows.stop - rows.start
        _require(modes, (self._kept, lines, width), self._dtype)
        _require(column, (self._sizes[1], count, width), self._dtype)
        _within(rows, lines)
        return (*self._sizes, lines * width, count * width), _address(modes) + rows.start * width * modes.itemsize

    def _exchange(self, function: Callable[..., None], column: np.ndarray, blocks: _Blocks, component: int,
                  rows: slice) -> None:
        planes, lines, width = blocks.shape
        _require(column, (planes, rows.stop - rows.start, width), self._dtype)
        _within(rows, lines)
        _within(slice(component, component + 1), blocks.components)
        function(ctypes.byref(blocks), component, rows.start, rows.stop - rows.start, _address(column))


class CompiledPlaneCopies:
    """Copies around transforms in planes: see `eddies.spectral.copies.PlaneCopies`, which is the definition and has the
    same methods. Arrays that lie as they do there, contiguous and of its precision, are needed: ValueError otherwise.
    """

    def __init__(self, library: ctypes.CDLL, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self._cells, self._cutoff, self._kept, self._dtype = cells, cutoff, 2 * cutoff + 1, np.dtype(dtype)
        self._real = np.zeros(1, self._dtype).real.dtype
        self._pack = _function(library, "pack", self._dtype, ADDRESS, *3 * [INT], ADDRESS)
        self._unpack = _function(library, "unpack", self._dtype, ADDRESS, *5 * [INT], ADDRESS)
        self._fill = _function(library, "fill", self._dtype, *4 * [INT], *4 * [ADDRESS])
        self._split, self._join = (_function(library, name, self._dtype, INT, *3 * [ADDRESS])
                                   for name in ("split", "join"))

    def described(self, blocks: Sequence[np.ndarray]) -> _Blocks:
        """Blocks as the other methods want them."""
        return _Blocks(blocks, 2, self._dtype)

    def pack(self, blocks: _Blocks, planes: slice) -> np.ndarray:
        """Packed modes of some planes."""
        pairs = self._pairs(blocks, planes)
        packed = np.empty((blocks.components, pairs, self._kept, self._kept), self._dtype)
        self._pack(ctypes.byref(blocks), blocks.components, planes.start, planes.stop - planes.start, _address(packed))
        return packed

    def filled(self, part: np.ndarray, factors: np.ndarray | None, rows: np.ndarray) -> Iterator[None]:
        """Copy packed modes of components, one after the other, times factors (1, 1, ky or 1, kx or 1) if there are
        any, to `rows` (pairs, y, x), which are transformed along y."""
        part, (pairs, _, width) = np.ascontiguousarray(part, self._dtype), rows.shape
        _require(part, (len(part), pairs, self._kept, self._kept), self._dtype)
        _require(rows, (pairs, self._cells, width), self._dtype)
        by_y = by_x = None
        if factors is not None:
            along_x = factors.shape[-1] > 1
            _require(factors, (1, 1, 1, self._kept) if along_x else (1, 1, self._kept, 1), self._dtype)
            by_y, by_x = (None, _address(factors)) if along_x else (_address(factors), None)
        given, place = _address(part), _address(rows)
        for component in range(len(part)):
            self._fill(pairs, self._cutoff, self._cells, width, given + component * part.strides[0], by_y, by_x, place)
            yield

    def unpack(self, rows: np.ndarray, blocks: _Blocks, component: int, planes: slice) -> None:
        """Twice the modes of some planes, to one component of blocks, of what has been transformed along y."""
        pairs, width = self._pairs(blocks, planes), rows.shape[-1]
        _require(rows, (pairs, self._cells, width), self._dtype)
        _within(slice(component, component + 1), blocks.components)
        self._unpack(ctypes.byref(blocks), component, planes.start, planes.stop - planes.start, self._cells, width,
                     _address(rows))

    def split(self, planes: np.ndarray, real: np.ndarray) -> None:
        """Complex planes (pairs, y, x) to real ones (planes, y, x)."""
        self._split(*self._halves(planes, real))

    def join(self, real: np.ndarray, planes: np.ndarray) -> None:
        """Real planes (planes, y, x) to complex ones (pairs, y, x)."""
        points, whole, f, g = self._halves(planes, real)
        self._join(points, f, g, whole)

    def _pairs(self, blocks: _Blocks, planes: slice) -> int:
        _within(planes, blocks.shape[0])
        if blocks.shape[1:] != (self._kept, self._cutoff + 1):
            raise ValueError(f"blocks of {blocks.shape} modes: (planes, {self._kept}, {self._cutoff + 1}) are needed")
        return _pairs_of(planes.stop - planes.start)

    def _halves(self, planes: np.ndarray, real: np.ndarray) -> tuple[int, int, int, int]:
        """Points, and the addresses of complex planes and of the first and the second half of real ones."""
        pairs = _pairs_of(len(real))
        _require(planes, (pairs, *real.shape[1:]), self._dtype)
        _require(real, real.shape, self._real)
        first = _address(real)
        return planes.size, _address(planes), first, first + (len(real) - pairs) * real.strides[0]


def _pairs_of(planes: int) -> int:
    if planes != 1 and planes % 2:
        raise ValueError(f"{planes} planes: an even number of them, or a single one, are needed")
    return (planes + 1) // 2


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


def _within(part: slice, size: int) -> None:
    if not 0 <= part.start < part.stop <= size:
        raise ValueError(f"{part.start} to {part.stop} of {size}")
