"""Real-to-complex Fourier transforms of slabs, keeping only the modes that dealiasing keeps."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from eddies.parallel.migration import Redistribution
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import Transpose, TransposeBuffers
from eddies.spectral.fourier_passes import ColumnPass, Part, PlanePass, PlanePlans
from eddies.spectral.mode_operators import ModeOperators

REAL = {"float64": np.float64, "float32": np.float32}
COMPLEX = {"float64": np.complex128, "float32": np.complex64}

# Entries of a symmetric matrix, in the order in which they are stored.
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

Expansion = Callable[[np.ndarray], Sequence[Part]]


class SpectralGrid(ModeOperators):
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
        self._batches: dict[tuple[str, int], _Batch] = {}
        self.column_pass = ColumnPass(self.cells, self.cutoff, self.complex)
        self.plane_pass = PlanePass(self.cells, self.cutoff, self.complex)
        self._wavenumbers()

    def _wavenumbers(self) -> None:
        unit = 2 * np.pi / self.decomposition.length
        signed = np.concatenate([np.arange(self.cutoff + 1), np.arange(-self.cutoff, 0)])
        start = self.column_starts[self.decomposition.rank]
        local = signed[start : start + self._transpose.y_count]
        #: integer wavenumbers of each axis, shaped to broadcast over (kz, ky, kx)
        self.index = (np.arange(self.cutoff + 1)[None, None, :], local[None, :, None], signed[:, None, None])
        self.index_squared = sum(axis.astype(np.int64) ** 2 for axis in self.index)
        super().__init__([(unit * axis).astype(self.real) for axis in self.index],
                         (unit**2 * self.index_squared).astype(self.real), np.stack)
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
        collected, copies = Collector(self, len(physical)), self.plane_pass.copies
        given = copies.described(np.require(physical, self.real, "CW"))
        for planes in self.plane_pass.blocks(self.decomposition.count):
            plans = collected.plans(1, planes)
            for component in range(len(physical)):
                copies.join(given, component, planes, plans.planes[0])
                collected.add(planes, plans, component)
        return collected.modes()

    def backward(self, spectral: np.ndarray) -> np.ndarray:
        """Real field (c, z_local, y, x) of Fourier coefficients (c, kz, ky_local, kx); the inverse of `forward`."""
        physical = np.empty((len(spectral), *self.physical_shape), self.real)
        copies = self.plane_pass.copies
        result = copies.described(physical)
        for planes, packed in self._packed_blocks(spectral):
            for component in range(len(physical)):
                plans = self.plane_pass.to_physical([packed[component : component + 1]], 1, packed.shape[1])
                copies.split(plans.planes[0], result, component, planes)
        return physical

    def multiply(self, spectral: np.ndarray, product: Callable[[np.ndarray, np.ndarray], None], results: int,
                 **fields: Any) -> np.ndarray:
        """Fourier coefficients (results, kz, ky_local, kx) of products of fields, formed at the grid points.

        `product(values, out)` gets the values (fields, pairs, y, 2 x) of the fields that `blocks` yields for the same
        arguments at some points and fills (results, pairs, y, 2 x).
        """
        collected = Collector(self, results)
        for planes, values in self._value_blocks(spectral, **fields):
            plans = collected.plans(results, planes)
            product(values, plans.values)
            collected.add(planes, plans)
        return collected.modes()

    def squares(self, vector: np.ndarray) -> np.ndarray:
        """Fourier coefficients (6, kz, ky_local, kx) of u_i u_j, ij = xx, yy, zz, xy, xz, yz, of those of a vector
        (3, kz, ky_local, kx)."""
        def product(u: np.ndarray, out: np.ndarray) -> None:
            for row, (i, j) in enumerate(SYMMETRIC):
                np.multiply(u[i], u[j], out=out[row])

        return self.multiply(vector, product, len(SYMMETRIC), fields=3)

    def blocks(self, spectral: np.ndarray, fields: int, expand: Expansion | None = None,
               z_derivatives: int = 0) -> Iterator[np.ndarray]:
        """Real fields at all grid points of this rank, those of some planes at a time: values (fields, pairs, y, 2 x).

        Planes come in pairs, the values of both at a point side by side; one of an odd number comes last, (fields, 1,
        y, x). A block of planes stays in cache while it is worked on; its memory is used again for the next one.

        Parameters
        ----------
        spectral : modes (c, kz, ky_local, kx).
        fields : number of fields yielded.
        expand : makes the fields, in parts (c_i, pairs, ky, kx), from packed modes in (ky, kx) of pairs of planes:
            those of `spectral`, followed by the derivatives along z of its first `z_derivatives` components. It may
            combine them and multiply by `d_dx` and `d_dy`; (d_dx, modes) is such a product that is made on the way. By
            default the fields are what it would be given.
        """
        for planes, values in self._value_blocks(spectral, fields, expand, z_derivatives):
            yield values[..., ::2] if planes.stop - planes.start == 1 else values

    def _value_blocks(self, spectral: np.ndarray, fields: int, expand: Expansion | None = None,
                      z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        """Blocks of planes and values (fields, pairs, y, 2 x); a single plane is its own partner."""
        for planes, packed in self._packed_blocks(spectral, z_derivatives):
            parts = [packed] if expand is None else expand(packed)
            yield planes, self.plane_pass.to_physical(parts, fields, packed.shape[1]).values

    def _packed_blocks(self, spectral: np.ndarray, z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        copies = self.plane_pass.copies
        blocks = self._columns_to_planes(spectral, z_derivatives).planes
        for planes in self.plane_pass.blocks(self.decomposition.count):
            yield planes, copies.pack(blocks, planes)

    def _columns_to_planes(self, spectral: np.ndarray, z_derivatives: int) -> _Batch:
        """Transform along z, components and the z derivatives of the first of them, and make them planes."""
        components, copies = len(spectral), self.column_pass.copies
        batch = self._batch("backward", components + z_derivatives)
        modes = copies.described(np.require(spectral, self.complex, "CW"))
        d_dz = copies.described((1j * self.wavevector[2].ravel()).astype(self.complex))
        fields = [(component, None) for component in range(components)]
        fields += [(component, d_dz) for component in range(z_derivatives)]
        for rows in self.column_pass.rows(self.spectral_shape[1]):
            column = self.column_pass.plan("BACKWARD", rows)
            for place, (component, factors) in enumerate(fields):
                copies.fill(modes, component, rows, factors, column.given)
                column.plan.execute()
                copies.send(column.result, batch.columns, place, rows)
        batch.buffers.to_planes()
        return batch

    def buffers(self, direction: str, components: int) -> TransposeBuffers:
        """What a batch of components is sent in; used again, so a direction is for one transform at a time."""
        return self._batch(direction, components).buffers

    def _batch(self, direction: str, components: int) -> _Batch:
        key = (direction, components)
        if key not in self._batches:
            buffers = self._transpose.buffers(components, self.cutoff + 1, self.complex)
            self._batches[key] = _Batch(buffers, self.column_pass.copies.described_blocks(buffers.column_blocks),
                                        self.plane_pass.copies.described_blocks(buffers.plane_blocks))
        return self._batches[key]

    def sum_modes(self, density: np.ndarray) -> float:
        """Sum of a real spectral quantity (..., kz, ky_local, kx) over all modes of the full spectrum, all ranks."""
        return float(global_sum(self.decomposition.comm, np.sum(self.multiplicity * density, dtype=np.float64)))

    def mean(self, physical: np.ndarray) -> np.ndarray:
        """Mean over the box of each component of (c, z_local, y, x); shape (c,)."""
        total = global_sum(self.decomposition.comm, physical.sum(axis=(1, 2, 3), dtype=np.float64))
        return total / self.cells**3


class _Batch(NamedTuple):
    """The memory that components are sent in, and its blocks as the copies of either side want them."""

    buffers: TransposeBuffers
    columns: Any
    planes: Any


class Collector:
    """Takes real fields a block of planes at a time and gives their Fourier coefficients."""

    def __init__(self, grid: SpectralGrid, components: int) -> None:
        self.grid, self.components = grid, components
        self._batch = grid._batch("forward", components)

    def plans(self, fields: int, planes: slice) -> PlanePlans:
        """Plans with memory for a block of planes of so many fields, to be filled and added."""
        return self.grid.plane_pass.plans("FORWARD", fields, (planes.stop - planes.start + 1) // 2)

    def add(self, planes: slice, plans: PlanePlans, component: int = 0) -> None:
        """Transform a block of planes along x and y: fields that are components from a first one on."""
        self.grid.plane_pass.to_modes(plans, self._batch.planes, component, planes)

    def modes(self) -> np.ndarray:
        """The Fourier coefficients (components, kz, ky_local, kx), once all planes are there; all ranks call it."""
        grid, copies = self.grid, self.grid.column_pass.copies
        self._batch.buffers.to_columns()
        spectral = np.empty((self.components, *grid.spectral_shape), grid.complex)
        result = copies.described(spectral)
        for rows in grid.column_pass.rows(grid.spectral_shape[1]):
            column = grid.column_pass.plan("FORWARD", rows)
            for component in range(self.components):
                copies.receive(self._batch.columns, component, rows, column.given)
                column.plan.execute()
                copies.store(column.result, 0.5 / grid.cells**3, result, component, rows)
        return spectral


def regrid(source: SpectralGrid, target: SpectralGrid, spectral: np.ndarray) -> np.ndarray:
    """A field (c, kz, ky, kx) of the modes on `source` with those that `target` keeps, finer or coarser; its other
    modes are zero."""
    K = min(source.cutoff, target.cutoff)
    planes = [np.r_[0 : K + 1, grid.modes - K : grid.modes] for grid in (source, target)]
    sent, received = (np.abs(grid.index[1].ravel()) <= K for grid in (source, target))
    ky = source.index[1].ravel()[sent]
    # Both grids cut the same ascending list of ky into blocks, so rows arrive in the order in which they are stored.
    position = np.where(ky >= 0, ky, ky + target.modes)
    owner = np.searchsorted(target.column_starts, position, side="right") - 1
    rows = np.moveaxis(spectral[:, planes[0]][:, :, sent, : K + 1], 2, 0)
    moved = Redistribution(source.decomposition.comm, owner).apply(rows)
    regridded = np.zeros((len(spectral), *target.spectral_shape), target.complex)
    regridded[:, planes[1][:, None], np.flatnonzero(received), : K + 1] = np.moveaxis(moved, 0, 2)
    return regridded
