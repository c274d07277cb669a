"""Real-to-complex Fourier transforms of slabs, keeping only the modes that dealiasing keeps."""

from __future__ import annotations

import numpy as np
import pyfftw

from eddies.parallel.migration import Redistribution
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import Transpose

REAL = {"float64": np.float64, "float32": np.float32}
COMPLEX = {"float64": np.complex128, "float32": np.complex64}


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

    Dropped modes are neither transformed further nor sent. Plans are made once per number of components.
    """

    def __init__(self, decomposition: SlabDecomposition, precision: str = "float64", cutoff: int | None = None) -> None:
        self.decomposition, self.cells = decomposition, decomposition.planes
        self.cutoff = (self.cells - 1) // 3 if cutoff is None else int(cutoff)
        self.precision, self.real, self.complex = precision, REAL[precision], COMPLEX[precision]
        self.modes = 2 * self.cutoff + 1
        self._transpose = Transpose(decomposition.comm, self.cells, self.modes)
        self._plans: dict[tuple[str, int], pyfftw.FFTW] = {}
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
        components, K = len(physical), self.cutoff
        along_x = self._plan("forward x", components)
        along_x.input_array[...] = physical
        along_x.execute()
        plane_plan = self._plan("forward y", components)
        plane_plan.execute()
        plane = plane_plan.output_array
        kept = np.empty((components, self.decomposition.count, self.modes, K + 1), self.complex)
        kept[:, :, : K + 1], kept[:, :, K + 1 :] = plane[:, :, : K + 1], plane[:, :, self.cells - K :]
        along_z = self._plan("forward z", components)
        along_z.input_array[...] = self._transpose.forward(kept)
        along_z.execute()
        column = along_z.output_array
        spectral = np.empty((components, *self.spectral_shape), self.complex)
        scale = self.real(1.0 / self.cells**3)
        np.multiply(column[:, : K + 1], scale, out=spectral[:, : K + 1])
        np.multiply(column[:, self.cells - K :], scale, out=spectral[:, K + 1 :])
        return spectral

    def backward(self, spectral: np.ndarray) -> np.ndarray:
        """Real field (c, z_local, y, x) of Fourier coefficients (c, kz, ky_local, kx); the inverse of `forward`."""
        components, K = len(spectral), self.cutoff
        along_z = self._plan("backward z", components)
        column = along_z.input_array
        column[:, : K + 1], column[:, self.cells - K :] = spectral[:, : K + 1], spectral[:, K + 1 :]
        column[:, K + 1 : self.cells - K] = 0
        along_z.execute()
        kept = self._transpose.backward(along_z.output_array)
        plane_plan = self._plan("backward y", components)
        plane = plane_plan.input_array
        plane[:, :, : K + 1], plane[:, :, self.cells - K :] = kept[:, :, : K + 1], kept[:, :, K + 1 :]
        plane[:, :, K + 1 : self.cells - K] = 0
        plane_plan.execute()
        along_x = self._plan("backward x", components)
        along_x.input_array[..., K + 1 :] = 0
        along_x.execute()
        return along_x.output_array.copy()

    def sum_modes(self, density: np.ndarray) -> float:
        """Sum of a real spectral quantity (..., kz, ky_local, kx) over all modes of the full spectrum, all ranks."""
        return float(global_sum(self.decomposition.comm, np.sum(self.multiplicity * density, dtype=np.float64)))

    def mean(self, physical: np.ndarray) -> np.ndarray:
        """Mean over the box of each component of (c, z_local, y, x); shape (c,)."""
        total = global_sum(self.decomposition.comm, physical.sum(axis=(1, 2, 3), dtype=np.float64))
        return total / self.cells**3

    def _plan(self, name: str, components: int) -> pyfftw.FFTW:
        """The FFTW plan of one pass, with its own aligned arrays; the y passes work in place inside the x arrays."""
        key = (name, components)
        if key not in self._plans:
            self._plans[key] = getattr(self, "_plan_" + name.split()[1])(name, components)
        return self._plans[key]

    # FFTW_ESTIMATE: measured plans may differ from run to run, and with them the last bits of the results.

    def _plan_x(self, name: str, components: int) -> pyfftw.FFTW:
        nz, n = self.decomposition.count, self.cells
        real = pyfftw.empty_aligned((components, nz, n, n), self.real)
        half = pyfftw.zeros_aligned((components, nz, n, n // 2 + 1), self.complex)
        if name == "forward x":
            return pyfftw.FFTW(real, half, axes=(3,), flags=("FFTW_ESTIMATE",))
        flags = ("FFTW_ESTIMATE", "FFTW_DESTROY_INPUT")
        return pyfftw.FFTW(half, real, axes=(3,), direction="FFTW_BACKWARD", flags=flags)

    def _plan_y(self, name: str, components: int) -> pyfftw.FFTW:
        direction = name.split()[0]
        x_plan = self._plan(f"{direction} x", components)
        half = x_plan.output_array if direction == "forward" else x_plan.input_array
        kept = half[..., : self.cutoff + 1]
        return pyfftw.FFTW(kept, kept, axes=(2,), direction=f"FFTW_{direction.upper()}", flags=("FFTW_ESTIMATE",))

    def _plan_z(self, name: str, components: int) -> pyfftw.FFTW:
        column = pyfftw.empty_aligned((components, self.cells, *self.spectral_shape[1:]), self.complex)
        direction = f"FFTW_{name.split()[0].upper()}"
        return pyfftw.FFTW(column, column, axes=(1,), direction=direction, flags=("FFTW_ESTIMATE",))


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
