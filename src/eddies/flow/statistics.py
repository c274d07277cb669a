"""What is measured of a flow: energy budget, scales, Reynolds and Mach number, spectrum, gradient moments."""

from __future__ import annotations

import numpy as np

from eddies.flow.operators import dot_wavevector, inverse_wavenumber_squared
from eddies.flow.spectral_grid import SpectralGrid
from eddies.parallel.reduction import global_sum


def energy_spectrum(grid: SpectralGrid, velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Wavenumbers k = 0, 1, ... and E(k), the energy of the modes with |k| rounding to k; sum E = <u.u>/2."""
    shell = np.rint(np.sqrt(grid.index_squared)).astype(int)
    shells = int(np.ceil(np.sqrt(3) * grid.cutoff)) + 1
    density = 0.5 * grid.multiplicity * (np.abs(velocity) ** 2).sum(axis=0)
    spectrum = np.bincount(shell.ravel(), density.ravel().astype(float), minlength=shells)
    return np.arange(shells), global_sum(grid.decomposition.comm, spectrum)


def turbulence_scales(spectrum: np.ndarray, dissipation_rate: float, viscosity: float, cutoff: int) -> dict[str, float]:
    """Scales of isotropic turbulence from E(k), the dissipation rate and the viscosity.

    u' = sqrt(2E/3), L = pi/(2u'^2) sum E/k, T = L/u', lambda = sqrt(15 nu u'^2/eps), Re_lambda = u' lambda/nu,
    eta = (nu^3/eps)^(1/4), t_eta = sqrt(nu/eps) (Pope 2000, chapter 6). Without viscosity those with it are 0 or inf.
    """
    energy = spectrum.sum()
    u_rms = np.sqrt(2 * energy / 3)
    k = np.arange(1, len(spectrum))
    integral_scale = np.pi / (2 * u_rms**2) * np.sum(spectrum[1:] / k) if energy > 0 else 0.0
    nu, eps = viscosity, dissipation_rate
    viscous = nu > 0 and eps > 0
    taylor_scale = np.sqrt(15 * nu * u_rms**2 / eps) if viscous else np.inf
    kolmogorov_length = (nu**3 / eps) ** 0.25 if viscous else 0.0
    return {
        "velocity_rms": u_rms,
        "integral_scale": integral_scale,
        "eddy_turnover_time": integral_scale / u_rms if energy > 0 else np.inf,
        "taylor_scale": taylor_scale,
        "reynolds_lambda": u_rms * taylor_scale / nu if viscous else np.inf,
        "kolmogorov_length": kolmogorov_length,
        "kolmogorov_time": np.sqrt(nu / eps) if viscous else np.inf,
        "kmax_eta": cutoff * kolmogorov_length,
    }


def longitudinal_gradient(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """du/dx, dv/dy, dw/dz at the grid points, (3, z_local, y, x), of the modes (3, kz, ky, kx) of a velocity."""
    modes = np.stack([1j * k * component for k, component in zip(grid.wavevector, velocity)])
    return grid.backward(modes.astype(grid.complex, copy=False))


def gradient_moments(grid: SpectralGrid, longitudinal: np.ndarray) -> tuple[float, float]:
    """Skewness and flatness of the longitudinal velocity gradient, averaged over the three directions."""
    second, third, fourth = (grid.mean(longitudinal**power) for power in (2, 3, 4))
    if not np.all(second > 0):
        return 0.0, 0.0
    return float(np.mean(third / second**1.5)), float(np.mean(fourth / second**2))


def incompressible_budget(grid: SpectralGrid, velocity: np.ndarray, viscosity: float) -> dict[str, float]:
    """Total energy <u.u>/2 and dissipation rate nu <|grad u|^2>, exact in Fourier space."""
    squared = (np.abs(velocity) ** 2).sum(axis=0)
    return {"total_energy": 0.5 * grid.sum_modes(squared),
            "dissipation_rate": viscosity * grid.sum_modes(grid.wavenumber_squared * squared)}


def compressible_budget(grid: SpectralGrid, state: np.ndarray, longitudinal: np.ndarray, viscosity: float,
                        sound_speed: float) -> dict[str, float]:
    """Total energy <rho |u|^2/2 + c^2 (rho ln rho - rho + 1)>, dissipation nu <rho (2 S:S - 2/3 (div u)^2)>.

    Without forcing the first decays at exactly the second. `longitudinal` is the velocity's `longitudinal_gradient`.
    Also the rms of the density and the share of the kinetic energy in the longitudinal velocity.
    """
    # Three components at a time: all nine gradients at once would need more memory than the time stepper.
    s = grid.backward(state[3:])[0]
    rho = np.exp(s)
    energy = 0.5 * rho * (grid.backward(state[:3]) ** 2).sum(axis=0) + sound_speed**2 * (rho * s - rho + 1)
    strain = (longitudinal**2).sum(axis=0) + 2 * (_shear(grid, state[:3]) ** 2).sum(axis=0)
    friction = rho * (2 * strain - 2 / 3 * longitudinal.sum(axis=0) ** 2)
    means = grid.mean(np.stack([energy, friction, rho, rho**2]))
    along = np.abs(dot_wavevector(grid, state[:3])) ** 2 * inverse_wavenumber_squared(grid)
    kinetic_spectral = grid.sum_modes((np.abs(state[:3]) ** 2).sum(axis=0))
    return {"total_energy": float(means[0]),
            "dissipation_rate": viscosity * float(means[1]),
            "density_rms": float(np.sqrt(max(means[3] - means[2] ** 2, 0.0))),
            "compressible_fraction": grid.sum_modes(along) / kinetic_spectral if kinetic_spectral > 0 else 0.0}


def _shear(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """The off-diagonal rates of strain S_xy, S_xz, S_yz at the grid points, (3, z_local, y, x)."""
    k, u = grid.wavevector, velocity
    modes = np.stack([0.5j * (k[j] * u[i] + k[i] * u[j]) for i, j in ((0, 1), (0, 2), (1, 2))])
    return grid.backward(modes.astype(grid.complex, copy=False))
