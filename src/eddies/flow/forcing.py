"""Deterministic linear forcing of the largest scales with a prescribed rate of energy injection."""

from __future__ import annotations

import numpy as np

from eddies.errors import UserError
from eddies.parallel.reduction import global_sum
from eddies.spectral.mode_operators import ModeOperators, gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid

# Share of the kinetic energy at the forced modes that round-off alone may leave there.
SILENT = {"float64": 1e-20, "float32": 1e-10}


class ForcingError(UserError, ValueError):
    """The flow cannot be forced."""


class LinearForcing:
    """f(k) = A u_s(k) for 0 < |k| < k_f with A = rate / sum |u_s|^2, so that the mean of u.f is `injection_rate`.

    u_s is the solenoidal part of the velocity. Where that is what a filter of `filter_width` has left, the sum is that
    of the modes with the filter undone: then f is the filtered forcing of the flow. Its form is that of Lundgren (2003)
    and Petersen and Livescu (2010), with the amplitude set at every evaluation. `wavenumber` is k_f.

    The few forced modes are collected on all ranks in one message. Their mirror images in the plane kx = 0 are made
    exact conjugates there: otherwise round-off in the part that no real field has would be amplified by the forcing.
    Raises ForcingError at the first evaluation if the velocity has no energy, but round-off, at the forced modes.
    """

    def __init__(self, grid: SpectralGrid, injection_rate: float, wavenumber: float,
                 filter_width: float = 0.0) -> None:
        self.grid, self.injection_rate, self.wavenumber = grid, injection_rate, wavenumber
        self._checked = False
        self.reach = reach = min(int(np.ceil(wavenumber)) - 1, grid.cutoff)
        signed = np.arange(-reach, reach + 1)
        kx, ky, kz = np.arange(reach + 1)[None, None, :], signed[None, :, None], signed[:, None, None]
        squared = kx**2 + ky**2 + kz**2
        self._operators = ModeOperators((kx, ky, kz), squared, np.stack)
        self._forced = (squared > 0) & (squared < wavenumber**2)
        unit = 2 * np.pi / grid.decomposition.length
        self._weights = np.where(kx == 0, 1, 2) / gaussian_transfer(unit**2 * squared, filter_width) ** 2
        # Where the forced modes of this rank stand in its spectral array, and in the small block.
        own_ky = grid.index[1].ravel()
        self._own_rows = np.flatnonzero(np.abs(own_ky) <= reach)
        self._block_rows = own_ky[self._own_rows] + reach
        self._planes = signed % grid.modes

    def add(self, velocity: np.ndarray, tendency: np.ndarray) -> None:
        """Add the force to the velocity components of `tendency` in place; both (3, kz, ky, kx), Fourier space."""
        if self.injection_rate == 0:
            return
        block = self._forced_modes(velocity)
        energy = float(np.sum(self._weights * np.abs(block) ** 2))
        if not self._checked:
            self._require_energy(energy, velocity)
        force = self.injection_rate / energy * block
        where = np.ix_(range(3), self._planes, self._own_rows, range(self.reach + 1))
        tendency[where] += force[:, :, self._block_rows, :].astype(tendency.dtype)

    def _require_energy(self, forced: float, velocity: np.ndarray) -> None:
        # Once is enough: modes that are forced do not run out of energy, and the sum costs a message.
        total = self.grid.sum_modes((np.abs(velocity) ** 2).sum(axis=0))
        if forced <= SILENT[self.grid.precision] * total:
            raise ForcingError("[forcing]: the flow has no energy at 0 < |k| < wavenumber = "
                               f"{self.wavenumber:g}, which linear forcing could amplify; start from a flow with "
                               "energy there, raise wavenumber, or remove [forcing]")
        self._checked = True

    def _forced_modes(self, velocity: np.ndarray) -> np.ndarray:
        """Solenoidal velocity of the forced modes on every rank: (3, 2 reach + 1, 2 reach + 1, reach + 1)."""
        block = np.zeros((3, *self._forced.shape), np.complex128)
        own = velocity[np.ix_(range(3), self._planes, self._own_rows, range(self.reach + 1))]
        block[:, :, self._block_rows] = own
        block = global_sum(self.grid.decomposition.comm, block)
        block[..., 0] = (block[..., 0] + block[:, ::-1, ::-1, 0].conj()) / 2
        return self._operators.solenoidal(block) * self._forced
