"""Real-to-complex Fourier transforms of slabs, with only the modes that dealiasing keeps."""

from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from eddies.kernels.copies import Blocks, Described
from eddies.kernels.library import require
from eddies.parallel.migration import Redistribution
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition, Transpose, block_starts
from eddies.spectral.fourier_passes import ColumnPass, Part, PlanePass
from eddies.spectral.mode_operators import ModeOperators

REAL = {"float64": np.float64, "float32": np.float32}
COMPLEX = {"float64": np.complex128, "float32": np.complex64}

# Indices (i, j) of the entries of a symmetric matrix, in the order in which they are stored.
SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))

Expansion = Callable[[np.ndarray], Sequence[Part]]


class _Batch(NamedTuple):
    """A transpose for a number of components, and its blocks in the form that ColumnCopies and PlaneCopies take."""

    transpose: Transpose
    columns: Blocks
    planes: Blocks


class SpectralGrid(ModeOperators):
    """Fourier transforms on a periodic cube of `cells`^3 points, divided into slabs, for modes with |k_i| <= cutoff.

    Physical arrays (components, z_local, y, x) are real. Spectral arrays (components, kz, ky_local, kx) are complex.
    They hold kz, ky = 0 ... K, -K ... -1 and kx = 0 ... K, where ky is divided among the ranks:

        f(x) = sum over k of f_hat(k) exp(i k.x),      f_hat(k) = mean over x of f(x) exp(-i k.x).

    Parameters
    ----------
    decomposition : slabs of `cells` planes.
    precision : "float64" or "float32".
    cutoff : largest wavenumber K of each direction, in units of 2 pi / length, at most (cells - 1) // 2. The default,
        the largest integer below cells / 3, makes quadratic products free of aliasing (Orszag 1971).

    Modes beyond the cutoff are dropped during the transform and are not sent to other ranks. All transforms are
    collective.
    """

    def __init__(self, decomposition: SlabDecomposition, precision: str = "float64", cutoff: int | None = None) -> None:
        self.decomposition, self.cells = decomposition, decomposition.planes
        self.cutoff = (self.cells - 1) // 3 if cutoff is None else int(cutoff)
        self.precision, self.real, self.complex = precision, REAL[precision], COMPLEX[precision]
        self.modes = 2 * self.cutoff + 1
        #: (ranks + 1,): number of each rank's first row of ky, counted in the order of storage, then the number of rows
        self.column_starts = block_starts(self.modes, decomposition.size)
        self._batches: dict[tuple[str, int], _Batch] = {}
        self.column_pass = ColumnPass(self.cells, self.cutoff, self.complex)
        self.plane_pass = PlanePass(self.cells, self.cutoff, self.complex)
        unit = 2 * np.pi / decomposition.length
        signed = np.concatenate([np.arange(self.cutoff + 1), np.arange(-self.cutoff, 0)])
        own = signed[slice(*self.column_starts[decomposition.rank :][:2])]
        #: integer wavenumbers of each axis, shaped to broadcast over (kz, ky, kx)
        self.index = (np.arange(self.cutoff + 1)[None, None, :], own[None, :, None], signed[:, None, None])
        self.index_squared = sum(axis.astype(np.int64) ** 2 for axis in self.index)
        super().__init__([(unit * axis).astype(self.real) for axis in self.index],
                         (unit**2 * self.index_squared).astype(self.real), np.stack)
        #: i kx and i ky, shaped to broadcast over the packed modes (c, pairs, ky, kx) in `expand` of `blocks`
        self.d_dx = (1j * unit * signed).astype(self.complex)[None, None, None, :]
        self.d_dy = (1j * unit * signed).astype(self.complex)[None, None, :, None]
        #: weight of a stored mode in a sum over all modes: 1 for kx = 0, where the mode -k is stored too; otherwise 2
        self.multiplicity = np.where(self.index[0] == 0, 1, 2).astype(self.real)
        #: shape (z_local, y, x) of one component in physical space on this rank
        self.physical_shape = (decomposition.count, self.cells, self.cells)
        #: shape (kz, ky_local, kx) of one component in Fourier space on this rank
        self.spectral_shape = (self.modes, len(own), self.cutoff + 1)

    @property
    def shell_number(self) -> np.ndarray:
        """|k| in units of 2 pi / length, rounded to integers: (kz, ky_local, kx)."""
        return np.rint(np.sqrt(self.index_squared)).astype(int)

    def coordinates(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return x, y, z of this rank's grid points, shaped to broadcast over (z_local, y, x)."""
        points = np.arange(self.cells) * self.decomposition.spacing
        own = points[self.decomposition.start : self.decomposition.stop]
        return points[None, None, :], points[None, :, None], own[:, None, None]

    def forward(self, physical: np.ndarray) -> np.ndarray:
        """Return the modes (c, kz, ky_local, kx) of a real field (c, z_local, y, x); `backward` is the inverse."""
        copies, blocks = self.plane_pass.copies, self._batch("forward", len(physical)).planes
        given = self._described(physical, self.real, self.physical_shape)
        for planes in self.plane_pass.blocks(self.decomposition.count):
            plans = self.plane_pass.plans("FORWARD", 1, planes)
            for component in range(len(physical)):
                copies.join(given, component, planes, plans.planes[0])
                self.plane_pass.to_modes(plans, blocks, component, planes)
        return self._planes_to_columns(len(physical))

    def backward(self, spectral: np.ndarray) -> np.ndarray:
        """Return the real field (c, z_local, y, x) of modes (c, kz, ky_local, kx); the inverse of `forward`."""
        physical = np.empty((len(spectral), *self.physical_shape), self.real)
        copies = self.plane_pass.copies
        result = Described(physical)
        for planes, packed in self._packed_blocks(spectral):
            for component in range(len(physical)):
                plans = self.plane_pass.to_physical([packed[component : component + 1]], 1, planes)
                copies.split(plans.planes[0], result, component, planes)
        return physical

    def multiply(self, spectral: np.ndarray, product: Callable[[np.ndarray, np.ndarray], None], results: int,
                 **fields: Any) -> np.ndarray:
        """Return the modes (results, kz, ky_local, kx) of products of fields, formed at the grid points.

        The fields are those of `blocks(spectral, **fields)`. The function `product(values, out)` gets their values
        (fields, pairs, y, 2 x) and writes the products to `out` (results, pairs, y, 2 x).
        """
        blocks = self._batch("forward", results).planes
        for planes, values in self._value_blocks(spectral, **fields):
            plans = self.plane_pass.plans("FORWARD", results, planes)
            product(values, plans.values)
            self.plane_pass.to_modes(plans, blocks, 0, planes)
        return self._planes_to_columns(results)

    def squares(self, vector: np.ndarray) -> np.ndarray:
        """Return the modes (6, kz, ky_local, kx) of u_i u_j, ij = xx, yy, zz, xy, xz, yz, given those of u."""
        def product(u: np.ndarray, out: np.ndarray) -> None:
            for row, (i, j) in enumerate(SYMMETRIC):
                np.multiply(u[i], u[j], out=out[row])

        return self.multiply(vector, product, len(SYMMETRIC), fields=3)

    def blocks(self, spectral: np.ndarray, fields: int, expand: Expansion | None = None,
               z_derivatives: int = 0) -> Iterator[np.ndarray]:
        """Yield the values (fields, pairs, y, 2 x) of real fields in a few planes at a time, until all planes are done.

        Planes come in pairs, with the values of both planes at a point (y, x) side by side. If the number of planes is
        odd, the last plane comes alone, as (fields, 1, y, x). A block of planes stays in cache while it is used. The
        next block uses the same memory.

        Parameters
        ----------
        spectral : modes (c, kz, ky_local, kx).
        fields : number of fields yielded.
        expand : function of packed modes (c, pairs, ky, kx), in which two planes f and g are one complex plane f + i g.
            It gets the packed modes of `spectral`, followed by those of the z derivatives of the first `z_derivatives`
            components. It returns the packed modes of the fields, as a list of parts (c_i, pairs, ky, kx). It may
            combine its input and multiply it by `d_dx` and `d_dy`. A part (d_dx, modes) means the product of the two,
            which is formed while the modes are copied. Without `expand`, the fields are those of its input.
        z_derivatives : number of components whose z derivatives `expand` gets.
        """
        for planes, values in self._value_blocks(spectral, fields, expand, z_derivatives):
            yield values[..., ::2] if planes.stop - planes.start == 1 else values

    def _value_blocks(self, spectral: np.ndarray, fields: int, expand: Expansion | None = None,
                      z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        """Yield slices of planes, and the values (fields, pairs, y, 2 x) there. A single plane is its own partner."""
        for planes, packed in self._packed_blocks(spectral, z_derivatives):
            parts = [packed] if expand is None else expand(packed)
            yield planes, self.plane_pass.to_physical(parts, fields, planes).values

    def _packed_blocks(self, spectral: np.ndarray, z_derivatives: int = 0) -> Iterator[tuple[slice, np.ndarray]]:
        copies = self.plane_pass.copies
        blocks = self._columns_to_planes(spectral, z_derivatives).planes
        for planes in self.plane_pass.blocks(self.decomposition.count):
            yield planes, copies.pack(blocks, planes)

    def _columns_to_planes(self, spectral: np.ndarray, z_derivatives: int) -> _Batch:
        """Transform modes along z and send the results to the ranks that own the planes; return the batch with them.

        The results are those of all components, followed by the z derivatives of the first `z_derivatives` components.
        """
        components, copies = len(spectral), self.column_pass.copies
        batch = self._batch("backward", components + z_derivatives)
        modes = self._described(spectral, self.complex, self.spectral_shape)
        d_dz = Described((1j * self.wavevector[2].ravel()).astype(self.complex))
        fields = [(component, None) for component in range(components)]
        fields += [(component, d_dz) for component in range(z_derivatives)]
        for rows in self.column_pass.rows(self.spectral_shape[1]):
            column = self.column_pass.plan("BACKWARD", rows)
            for place, (component, factors) in enumerate(fields):
                copies.fill(modes, component, rows, factors, column.given)
                column.plan.execute()
                copies.send(column.result, batch.columns, place, rows)
        batch.transpose.to_planes()
        return batch

    def _described(self, array: np.ndarray, dtype: type, shape: tuple[int, ...]) -> Described:
        """Return an array as `Described`, after conversion to `dtype`. Raise ValueError unless it is (c, *shape)."""
        array = np.require(array, dtype, "CW")
        require(array, (len(array), *shape), dtype)
        return Described(array)

    def _planes_to_columns(self, components: int) -> np.ndarray:
        """Send the components in the "forward" batch to the ranks of their columns; return them transformed along z."""
        batch, copies = self._batch("forward", components), self.column_pass.copies
        batch.transpose.to_columns()
        spectral = np.empty((components, *self.spectral_shape), self.complex)
        result = Described(spectral)
        for rows in self.column_pass.rows(self.spectral_shape[1]):
            column = self.column_pass.plan("FORWARD", rows)
            for component in range(components):
                copies.receive(batch.columns, component, rows, column.given)
                column.plan.execute()
                copies.store(column.result, 0.5 / self.cells**3, result, component, rows)
        return spectral

    def _batch(self, direction: str, components: int) -> _Batch:
        """Return the buffers of transforms of `components` components in this `direction`, "forward" or "backward".

        Only one transform at a time may use them.
        """
        key = (direction, components)
        if key not in self._batches:
            transpose = Transpose(self.decomposition.comm, self.cells, self.modes, components, self.cutoff + 1,
                                  self.complex)
            self._batches[key] = _Batch(transpose, self.column_pass.copies.described_blocks(transpose.column_blocks),
                                        self.plane_pass.copies.described_blocks(transpose.plane_blocks))
        return self._batches[key]

    def sum_modes(self, density: np.ndarray) -> float:
        """Return the sum of a real quantity `density` (..., kz, ky_local, kx) over all modes and ranks; collective."""
        return float(global_sum(self.decomposition.comm, np.sum(self.multiplicity * density, dtype=np.float64)))

    def mean(self, physical: np.ndarray) -> np.ndarray:
        """Return the means (c,) over the box of the components of an array (c, z_local, y, x); collective."""
        total = global_sum(self.decomposition.comm, physical.sum(axis=(1, 2, 3), dtype=np.float64))
        return total / self.cells**3


def regrid(source: SpectralGrid, target: SpectralGrid, spectral: np.ndarray) -> np.ndarray:
    """Return the modes, on the grid `target`, of fields with the modes `spectral` (c, kz, ky, kx) on the grid `source`.

    Modes that `source` does not have are 0. Collective.
    """
    K = min(source.cutoff, target.cutoff)
    planes = [np.r_[0 : K + 1, grid.modes - K : grid.modes] for grid in (source, target)]
    sent, received = (np.abs(grid.index[1].ravel()) <= K for grid in (source, target))
    ky = source.index[1].ravel()[sent]
    # Both grids store ky in the same order, in consecutive blocks, so rows arrive in storage order.
    position = np.where(ky >= 0, ky, ky + target.modes)
    owner = np.searchsorted(target.column_starts, position, side="right") - 1
    rows = np.moveaxis(spectral[:, planes[0]][:, :, sent, : K + 1], 2, 0)
    moved = Redistribution(source.decomposition.comm, owner).apply(rows)
    regridded = np.zeros((len(spectral), *target.spectral_shape), target.complex)
    regridded[:, planes[1][:, None], np.flatnonzero(received), : K + 1] = np.moveaxis(moved, 0, 2)
    return regridded
