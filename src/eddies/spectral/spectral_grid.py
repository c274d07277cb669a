"""Real-to-complex Fourier transforms of slabs, keeping only the modes that dealiasing keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from eddies.parallel.migration import Redistribution
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import Transpose, TransposeBuffers
from eddies.spectral.fourier_passes import ColumnPass, PlanePass

REAL = {"float64": np.float64, "float32": np.float32}
COMPLEX = {"float64": np.complex128, "float32": np.complex64}

Expansion = Callable[[np.ndarray], Sequence[np.ndarray]]


class SpectralGrid:
    """Fourier transforms on a periodic cube of `cells`^3 points, slab-decomposed, with the modes |k_i| <= cutoff.

    Physical arrays are (components, z_local, y, x), real. Spectral arrays are (components, kz, ky_local, kx), complex,
    holding kz, ky = 0 ... K, -K ... -1 and kx = 0 ... K, with ky cut among the ranks:

        f(x) = sum over k of f_hat(k) exp(i k.x),      f_hat(k) = mean over x of f(x) exp(-i k.x).

    Parameters
    ----------
    decomposition : slabs of `cells` planes.
    precision : "float64" or "float32".
    cutoff : largest wavenumber K kept in each direction, in units of 2 pi / length. The default, the largest integer
        below cells / 3, makes quadratic products free of aliasing (Orszag 1971). At most (cells - 1) // 2.

    Dropped modes are neither transformed further nor sent.
    """

    def __init__(self, decomposition: SlabDecomposition, precision: str = "float64", cutoff: int | None = None) -> None:
        self.decomposition, self.cells = decomposition, decomposition.planes
        self.cutoff = (self.cells - 1) // 3 if cutoff is None else int(cutoff)
        self.precision, self.real, self.complex = precision, REAL[precision], COMPLEX[precision]
        self.modes = 2 * self.cutoff + 1
        self._transpose = Transpose(decomposition.comm, self.cells, self.modes)
        self._buffers: dict[tuple[str, int], TransposeBuffers] = {}
        self.column_pass = ColumnPass(self.cells, self.cutoff + 1, self.complex)
        self.plane_pass = PlanePass(self.cells, self.cutoff, self.complex)
        self._wavenumbers()

    def _wavenumbers(self) -> None:
        unit = 2 * np.pi / self.decomposition.length
        signed = np.concatenate([np.arange(self.cutoff + 1), np.arange(-self.cutoff, 0)])
        start = self.column_starts[self.decomposition.rank]
        local = signed[start : start + self._transpose.y_count]
        #: integer wavenumbers of each axis, shaped to broadcast over (kz, ky, kx)
        self.index = (np.arange(self.cutoff + 1)[None, None, :], local[None, :, None], signed[:, None, None])
        self.wavevector = tuple((unit * axis).astype(self.real) for axis in self.index)
        self.index_squared = sum(axis.astype(np.int64) ** 2 for axis in self.index)
        self.wavenumber_squared = (unit**2 * self.index_squared).astype(self.real)
        #: i kx and i ky for the modes in (ky, kx) that an `expand` of `blocks` gets, all of them in storage order
        self.d_dx = (1j * unit * signed).astype(self.complex)[None, None, None, :]
        self.d_dy = (1j * unit * signed).astype(self.complex)[None, None, :, None]
        #: how often a stored mode stands in the full sum: twice, but for kx = 0, whose mirror image is stored itself
        self.multiplicity = np.where(self.index[0] == 0, 1, 2).astype(self.real)

    @property
    def physical_shape(self) -> tuple[int, int, int]:
        """Shape (z_local, y, x) of one component in physical space on this rank."""
        return (self.decomposition.count, self.cells, self.cells)

    @property
    def spectral_shape(self) -> tuple[int, int, int]:
        """Shape (kz, ky_local, kx) of one component in Fourier space on this rank."""
        return (self.modes, self._transpose.y_count, self.cutoff + 1)

    @property
    def column_starts(self) -> np.ndarray:
        """First ky, in storage order, of each rank, and their number: (ranks + 1,)."""
        return self._transpose.y_starts

    def coordinates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """x, y, z of this rank's grid points, shaped to broadcast over (z_local, y, x)."""
        points = np.arange(self.cells) * self.decomposition.spacing
        own = points[self.decomposition.start : self.decomposition.stop]
        return points[None, None, :], points[None, :, None], own[:, None, None]

    def forward(self, physical: np.ndarray) -> np.ndarray:
        """Fourier coefficients (c, kz, ky_local, kx) of a real field (c, z_local, y, x); `backward` is its inverse."""
        collected = Collector(self, len(physical))
        for planes in self.plane_pass.blocks(self.decomposition.count):
            collected.add(planes, physical[:, planes])
        return collected.modes()

    def backward(self, spectral: np.ndarray) -> np.ndarray:
        """Real field (c, z_local, y, x) of Fourier coefficients (c, kz, ky_local, kx); the inverse of `forward`."""
        physical = np.empty((len(spectral), *self.physical_shape), self.real)
        for planes, packed in self._packed_blocks(spectral):
            self.plane_pass.to_physical([packed], planes.stop - planes.start, physical[:, planes])
        return physical

    def multiply(self, spectral: np.ndarray, product: Callable[[np.ndarray, np.ndarray], None], results: int,
                 **fields: Any) -> np.ndarray:
        """Fourier coefficients (results, kz, ky_local, kx) of products of fields, formed at the grid points.

        `product(values, out)` gets what `blocks` yields for the same arguments and fills (results, planes, y, x).
        """
        collected, out = Collector(self, results), None
        for planes, values in self.blocks(spectral, **fields):
            if out is None or out.shape[1:] != values.shape[1:]:
                out = np.empty((results, *values.shape[1:]), self.real)
            product(values, out)
            collected.add(planes, out)
        return collected.modes()

    def blocks(self, spectral: np.ndarray, fields: int, expand: Expansion | None = None,
               z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        """Real fields at the grid points, some planes at a time: pairs of planes and values (fields, planes, y, x).

        A block of planes stays in cache while it is worked on; its memory is used again for the next one.

        Parameters
        ----------
        spectral : modes (c, kz, ky_local, kx).
        fields : number of fields yielded.
        expand : makes the fields, in parts (c_i, planes, ky, kx), from modes in (ky, kx) of planes: those of
            `spectral`, followed by the derivatives along z of its first `z_derivatives` components. It may combine
            them and multiply by `d_dx` and `d_dy`. By default the fields are what it would be given.
        """
        values: dict[int, np.ndarray] = {}
        for planes, packed in self._packed_blocks(spectral, z_derivatives):
            size = planes.stop - planes.start
            if size not in values:
                values[size] = np.empty((fields, size, self.cells, self.cells), self.real)
            self.plane_pass.to_physical([packed] if expand is None else expand(packed), size, values[size])
            yield planes, values[size]

    def _packed_blocks(self, spectral: np.ndarray, z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        buffers = self._columns_to_planes(spectral, z_derivatives)
        for planes in self.plane_pass.blocks(self.decomposition.count):
            yield planes, self.plane_pass.pack(_joined(buffers.plane_blocks, planes))

    def _columns_to_planes(self, spectral: np.ndarray, z_derivatives: int) -> TransposeBuffers:
        """Transform along z, components and the z derivatives of the first of them, and make them planes."""
        components, K, n = len(spectral), self.cutoff, self.cells
        buffers = self.buffers("backward", components + z_derivatives)
        d_dz = (1j * self.wavevector[2][:, 0]).astype(self.complex)[:, None]
        parts = [(spectral, slice(0, components), None)]
        if z_derivatives:
            parts.append((spectral[:z_derivatives], slice(components, components + z_derivatives), d_dz))
        for modes, where, factor in parts:
            for rows in self.column_pass.rows(self.spectral_shape[1], len(modes)):
                plan = self.column_pass.plan("BACKWARD", len(modes), rows.stop - rows.start)
                column = plan.input_array
                for kept, place in ((slice(0, K + 1), slice(0, K + 1)), (slice(K + 1, None), slice(n - K, None))):
                    if factor is None:
                        column[:, place] = modes[:, kept, rows]
                    else:
                        np.multiply(modes[:, kept, rows], factor[kept], out=column[:, place])
                plan.execute()
                for block, start in zip(buffers.column_blocks, self._transpose.z_starts):
                    block[where, :, rows] = plan.output_array[:, start : start + block.shape[1]]
        buffers.to_planes()
        return buffers

    def buffers(self, direction: str, components: int) -> TransposeBuffers:
        """What a batch of components is sent in; used again, so a direction is for one transform at a time."""
        key = (direction, components)
        if key not in self._buffers:
            self._buffers[key] = self._transpose.buffers(components, self.cutoff + 1, self.complex)
        return self._buffers[key]

    def sum_modes(self, density: np.ndarray) -> float:
        """Sum of a real spectral quantity (..., kz, ky_local, kx) over all modes of the full spectrum, all ranks."""
        return float(global_sum(self.decomposition.comm, np.sum(self.multiplicity * density, dtype=np.float64)))

    def mean(self, physical: np.ndarray) -> np.ndarray:
        """Mean over the box of each component of (c, z_local, y, x); shape (c,)."""
        total = global_sum(self.decomposition.comm, physical.sum(axis=(1, 2, 3), dtype=np.float64))
        return total / self.cells**3


class Collector:
    """Takes real fields (components, planes, y, x) a block of planes at a time and gives their Fourier coefficients."""

    def __init__(self, grid: SpectralGrid, components: int) -> None:
        self.grid, self.components = grid, components
        self._buffers = grid.buffers("forward", components)

    def add(self, planes: slice, values: np.ndarray) -> None:
        """Transform a block of planes along x and y."""
        transform = self.grid.plane_pass
        modes = transform.unpack(transform.to_modes(values), planes.stop - planes.start)
        start = 0
        for block in self._buffers.plane_blocks:
            block[:, planes] = modes[:, :, start : start + block.shape[2]]
            start += block.shape[2]

    def modes(self) -> np.ndarray:
        """The Fourier coefficients (components, kz, ky_local, kx), once all planes are there; all ranks call it."""
        grid, K = self.grid, self.grid.cutoff
        self._buffers.to_columns()
        spectral = np.empty((self.components, *grid.spectral_shape), grid.complex)
        scale = grid.real(0.5 / grid.cells**3)
        for rows in grid.column_pass.rows(grid.spectral_shape[1], self.components):
            plan = grid.column_pass.plan("FORWARD", self.components, rows.stop - rows.start)
            np.concatenate([block[:, :, rows] for block in self._buffers.column_blocks], axis=1, out=plan.input_array)
            plan.execute()
            column = plan.output_array
            np.multiply(column[:, : K + 1], scale, out=spectral[:, : K + 1, rows])
            np.multiply(column[:, grid.cells - K :], scale, out=spectral[:, K + 1 :, rows])
        return spectral


def _joined(blocks: Sequence[np.ndarray], planes: slice) -> np.ndarray:
    """Some planes of blocks (c, planes, y, x) that follow each other in y."""
    return blocks[0][:, planes] if len(blocks) == 1 else np.concatenate([block[:, planes] for block in blocks], axis=2)


def restrict(fine: SpectralGrid, coarse: SpectralGrid, spectral: np.ndarray) -> np.ndarray:
    """The modes of a field (c, kz, ky, kx) on `fine` that `coarse`, with an equal or smaller cutoff, keeps."""
    if coarse.cutoff > fine.cutoff:
        raise ValueError(f"cannot restrict modes up to {fine.cutoff} to a grid with modes up to {coarse.cutoff}")
    K = coarse.cutoff
    planes = np.concatenate([np.arange(K + 1), np.arange(fine.modes - K, fine.modes)])
    ky = fine.index[1].ravel()
    kept = np.abs(ky) <= K
    # Both grids cut the same ascending list of ky into blocks, so rows arrive in the order in which they are stored.
    position = np.where(ky >= 0, ky, ky + coarse.modes)[kept]
    owner = np.searchsorted(coarse.column_starts, position, side="right") - 1
    rows = np.moveaxis(spectral[:, planes][:, :, kept, : K + 1], 2, 0)
    moved = Redistribution(fine.decomposition.comm, owner).apply(rows)
    return np.ascontiguousarray(np.moveaxis(moved, 0, 2)).astype(coarse.complex, copy=False)
