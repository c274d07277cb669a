"""Deterministic linear forcing of the largest scales with a prescribed injection rate of energy."""

import numpy as np

from eddies.errors import UserError
from eddies.parallel.reduction import global_sum
from eddies.spectral.mode_operators import ModeOperators, gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid

# Largest share of the kinetic energy, without that of the mean velocity, that round-off can leave at the forced modes.
SILENT = {"float64": 1e-20, "float32": 1e-10}


class LinearForcing:
    """Force f(k) = A u_s(k) for 0 < |k| < `wavenumber`, with A = P / sum |u_s|^2, so that <u.f> = P = `injection_rate`.

    u_s is the solenoidal part of the velocity. This is the form of Lundgren (2003) and of Petersen and Livescu (2010).
    A is computed at every evaluation. If the velocity has passed a Gaussian filter of `filter_width`, the sum uses the
    unfiltered modes, and f is the filtered force of the unfiltered flow.

    All ranks hold the few forced modes; one reduction collects them. In the plane kx = 0, the modes k and -k are both
    stored, and they are made conjugate. Otherwise the forcing would amplify round-off errors. The first evaluation
    raises UserError if the velocity has no energy at the forced modes.
    """

    def __init__(self, grid: SpectralGrid, injection_rate: float, wavenumber: float,
                 filter_width: float = 0.0) -> None:
        self.grid, self.injection_rate, self.wavenumber = grid, injection_rate, wavenumber
        self._checked = False
        reach = min(int(np.ceil(wavenumber)) - 1, grid.cutoff)
        signed = np.arange(-reach, reach + 1)
        kx, ky, kz = np.arange(reach + 1)[None, None, :], signed[None, :, None], signed[:, None, None]
        squared = kx**2 + ky**2 + kz**2
        self._operators = ModeOperators((kx, ky, kz), squared, np.stack)
        self._forced = (squared > 0) & (squared < wavenumber**2)
        unit = 2 * np.pi / grid.decomposition.length
        self._weights = np.where(kx == 0, 1, 2) / gaussian_transfer(unit**2 * squared, filter_width) ** 2
        # Indices along ky of the forced modes: in this rank's array, and in the block of all forced modes.
        own_ky = grid.index[1].ravel()
        self._own_rows = np.flatnonzero(np.abs(own_ky) <= reach)
        self._block_rows = own_ky[self._own_rows] + reach
        self._own = np.ix_(range(3), signed % grid.modes, self._own_rows, range(reach + 1))

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity's `tendency` in place; both are modes (3, kz, ky, kx)."""
        if self.injection_rate == 0:
            return
        block = self._forced_modes(velocity)
        energy = float(np.sum(self._weights * np.abs(block) ** 2))
        if not self._checked:
            self._require_energy(energy, velocity)
        force = self.injection_rate / energy * block
        tendency[self._own] += force[:, :, self._block_rows, :].astype(tendency.dtype)

    def _require_energy(self, forced: float, velocity: np.ndarray) -> None:
        # One check is enough, because forced modes do not lose all their energy. The sum costs a message.
        total = self.grid.sum_modes((np.abs(velocity) ** 2).sum(axis=0) * (self.grid.index_squared > 0))
        if forced <= SILENT[self.grid.precision] * total:
            raise UserError("[forcing]: the flow has no energy at 0 < |k| < wavenumber = "
                            f"{self.wavenumber:g}, which linear forcing could amplify; start from a flow with "
                            "energy there, raise wavenumber, or remove [forcing]")
        self._checked = True

    def _forced_modes(self, velocity: np.ndarray) -> np.ndarray:
        """Return the solenoidal velocity of the forced modes, (3, kz, ky, kx), on every rank."""
        block = np.zeros((3, *self._forced.shape), np.complex128)
        block[:, :, self._block_rows] = velocity[self._own]
        block = global_sum(self.grid.decomposition.comm, block)
        block[..., 0] = (block[..., 0] + block[:, ::-1, ::-1, 0].conj()) / 2
        return self._operators.solenoidal(block) * self._forced
