"""Copies before and after the one-dimensional Fourier transforms on a slab.

Along an axis of `cells` points a transform keeps the modes 0 ... K at the beginning of its array and -K ... -1 at the
end. The gap between them stays zero. Arrays that are used many times are `Described` once, because numpy takes long
to return an address. Arrays must be contiguous and of the given precision; ValueError otherwise.
"""

import ctypes
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from eddies.kernels.library import ADDRESS, INT, NUMBER, library, members, require


class Blocks(ctypes.Structure):
    """Blocks that are successive parts of one array (components, planes, lines, width) along axis 1 or 2."""

    _fields_ = members(INT, "ranks planes lines width") + members(ADDRESS, "addresses starts")

    def __init__(self, blocks: Sequence[np.ndarray], axis: int, dtype: np.dtype) -> None:
        counts = [block.shape[axis] for block in blocks]
        shape = list(blocks[0].shape)
        for block, shape[axis] in zip(blocks, counts):
            require(block, tuple(shape), dtype)
        shape[axis] = sum(counts)
        self.shape = tuple(shape)
        self._kept = blocks, np.array([block.ctypes.data for block in blocks], np.uint64), np.cumsum([0, *counts])
        super().__init__(len(blocks), *self.shape[1:], *(array.ctypes.data for array in self._kept[1:]))


class Described:
    """An array with its address, shape and strides.

    The array must be contiguous. If `gaps` is true, only its parts array[i] must be contiguous. `apart` is the number
    of elements from the beginning of one part to the beginning of the next.
    """

    def __init__(self, array: np.ndarray, gaps: bool = False) -> None:
        contiguous = array[0] if gaps else array
        require(contiguous, contiguous.shape, array.dtype)
        self._array, self.address = array, array.ctypes.data
        self.shape, self.strides = array.shape, array.strides
        self.apart = array.strides[0] // array.itemsize


class _Copies:
    """The functions of the library for arrays of one precision."""

    exchanged_axis: int

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        self._cells, self._cutoff, self._kept, self._dtype = cells, cutoff, 2 * cutoff + 1, np.dtype(dtype)

    def described_blocks(self, blocks: Sequence[np.ndarray]) -> Blocks:
        return Blocks(blocks, self.exchanged_axis, self._dtype)

    def _function(self, name: str, *arguments: type) -> Callable[..., None]:
        precision = "float64" if self._dtype == np.complex128 else "float32"
        function = getattr(library(), f"copies_{name}_{precision}")
        function.argtypes, function.restype = arguments, None
        return function


class ColumnCopies(_Copies):
    """Copies between modes, columns and blocks for transforms along z.

    Modes have shape (c, kz, y, x). A column (z, rows, x) holds one component at consecutive values of y, the `rows`. It
    may have gaps in memory between successive z. The ranks exchange blocks (c, z, y, x), which are successive parts
    along z.
    """

    exchanged_axis = 1

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        super().__init__(cells, cutoff, dtype)
        self._fill = self._function("fill_column", *5 * [INT], *3 * [ADDRESS])
        self._store = self._function("store_column", *5 * [INT], ADDRESS, NUMBER, ADDRESS)
        self._send = self._function("send_column", ADDRESS, *4 * [INT], ADDRESS)
        self._receive = self._function("receive_column", ADDRESS, *4 * [INT], ADDRESS)

    def fill(self, modes: Described, component: int, rows: slice, factors: Described | None, column: Described) -> None:
        """Copy the modes of a component at some `rows` to a column. Factors (kz,), if given, multiply the modes."""
        sizes, start = self._sizes(modes, component, rows, column)
        self._fill(*sizes, start, None if factors is None else factors.address, column.address)

    def store(self, column: Described, scale: float, modes: Described, component: int, rows: slice) -> None:
        """Copy a column, multiplied by `scale`, to the modes of a component at some `rows`."""
        sizes, start = self._sizes(modes, component, rows, column)
        self._store(*sizes, column.address, scale, start)

    def send(self, column: Described, blocks: Blocks, component: int, rows: slice) -> None:
        """Copy a column, part by part along z, to a component of all blocks at some `rows`."""
        self._exchange(self._send, column, blocks, component, rows)

    def receive(self, blocks: Blocks, component: int, rows: slice, column: Described) -> None:
        """Copy a component of all blocks at some `rows` to a column. The blocks become its successive parts along z."""
        self._exchange(self._receive, column, blocks, component, rows)

    def _sizes(self, modes: Described, component: int, rows: slice, column: Described) -> tuple[tuple[int, ...], int]:
        """Return sizes for the library, and the address of the rows in the modes."""
        _, _, lines, width = modes.shape
        start = modes.address + component * modes.strides[0] + rows.start * modes.strides[2]
        return (self._cutoff, self._cells, lines * width, column.shape[1] * width, column.apart), start

    def _exchange(self, function: Callable[..., None], column: Described, blocks: Blocks, component: int,
                  rows: slice) -> None:
        function(ctypes.byref(blocks), component, rows.start, rows.stop - rows.start, column.apart, column.address)


class PlaneCopies(_Copies):
    """Copies between blocks, packed modes and planes for transforms in (y, x).

    The ranks exchange blocks (c, planes, y, x) of the modes with kx >= 0, which are successive parts along y. Two real
    planes f and g are transformed as one complex plane f + i g. Of the planes that are transformed together, f is in
    the first half, and g has the same place in the second half. The packed modes (c, pairs, ky, kx) of f + i g hold
    kx = 0 ... K, -K ... -1. The number of planes is even, or one; with one plane, f and g are the same plane. Because
    of round-off, a mode with kx = 0 may differ from the conjugate of its mirror image. The mean of both is then taken.
    """

    exchanged_axis = 2

    def __init__(self, cells: int, cutoff: int, dtype: np.dtype) -> None:
        super().__init__(cells, cutoff, dtype)
        self._pack = self._function("pack", ADDRESS, *3 * [INT], ADDRESS)
        self._unpack = self._function("unpack", ADDRESS, *5 * [INT], ADDRESS)
        self._fill = self._function("fill", *4 * [INT], *4 * [ADDRESS])
        self._split, self._join = (self._function(name, INT, *3 * [ADDRESS]) for name in ("split", "join"))

    def pack(self, blocks: Blocks, planes: slice) -> np.ndarray:
        """Return the packed modes of some planes."""
        components, count = blocks.shape[0], planes.stop - planes.start
        packed = np.empty((components, (count + 1) // 2, self._kept, self._kept), self._dtype)
        self._pack(ctypes.byref(blocks), components, planes.start, count, _address(packed))
        return packed

    def filled(self, part: np.ndarray, factors: np.ndarray | None, rows: Described) -> Iterator[None]:
        """Copy packed modes to `rows` (pairs, y, x), the input of the transform along y, one component per iteration.

        Factors (1, 1, ky, 1) or (1, 1, 1, kx), if given, multiply the modes.
        """
        part, (pairs, _, width) = np.ascontiguousarray(part, self._dtype), rows.shape
        require(part, (len(part), pairs, self._kept, self._kept), self._dtype)
        by_y = by_x = None
        if factors is not None:
            along_x = factors.shape[-1] > 1
            require(factors, (1, 1, 1, self._kept) if along_x else (1, 1, self._kept, 1), self._dtype)
            by_y, by_x = (None, _address(factors)) if along_x else (_address(factors), None)
        first = _address(part)
        for component in range(len(part)):
            self._fill(pairs, self._cutoff, self._cells, width, first + component * part.strides[0], by_y, by_x,
                       rows.address)
            yield

    def unpack(self, rows: Described, blocks: Blocks, component: int, planes: slice) -> None:
        """Store the modes of some `planes` in a component of the blocks. The modes are in `rows`, the output of the
        transform along y. The stored values are twice the modes."""
        self._unpack(ctypes.byref(blocks), component, planes.start, planes.stop - planes.start, self._cells,
                     rows.shape[-1], rows.address)

    def split(self, complex_planes: Described, real: Described, component: int, planes: slice) -> None:
        """Copy complex planes (pairs, y, x) to some real planes of fields (c, planes, y, x)."""
        self._split(*self._halves(complex_planes, real, component, planes))

    def join(self, real: Described, component: int, planes: slice, complex_planes: Described) -> None:
        """Copy some real planes of fields (c, planes, y, x) to complex planes (pairs, y, x)."""
        points, place, f, g = self._halves(complex_planes, real, component, planes)
        self._join(points, f, g, place)

    def _halves(self, complex_planes: Described, real: Described, component: int, planes: slice) -> tuple[int, ...]:
        """Return the number of points, and the addresses of the complex planes and of the first and the second half of
        the real planes."""
        count, (pairs, y, x) = planes.stop - planes.start, complex_planes.shape
        f = real.address + component * real.strides[0] + planes.start * real.strides[1]
        return pairs * y * x, complex_planes.address, f, f + (count - pairs) * real.strides[1]


def _address(array: np.ndarray) -> int:
    # Three times as fast as array.ctypes.data; every block of planes asks for several addresses.
    return ctypes.addressof(ctypes.c_char.from_buffer(array))
