"""Statistics of a flow: energy budget, scales, spectrum, and moments of the velocity gradient.

Velocities are given by their modes (3, kz, ky, kx). <.> is the mean over the box, and u is the velocity minus its mean:
a mean velocity is no turbulence, and depends on the frame of reference. Only `total_energy` contains it. All functions
with a grid are collective.
"""

import numpy as np

from eddies.parallel.reduction import global_sum
from eddies.spectral.spectral_grid import SpectralGrid


def energy_spectrum(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """Return the spectrum E(k), k = 0, 1, ...: E(k) is the energy of the modes whose |k| rounds to k.

    |k| is in units of 2 pi / length. The sum of E(k) over k is <u.u>/2, and E(0) is 0.
    """
    shells = int(np.ceil(np.sqrt(3) * grid.cutoff)) + 1
    density = 0.5 * grid.multiplicity * _squared(grid, velocity)
    spectrum = np.bincount(grid.shell_number.ravel(), density.ravel().astype(float), minlength=shells)
    return global_sum(grid.decomposition.comm, spectrum)


def component_energies(grid: SpectralGrid, velocity: np.ndarray) -> dict[str, float]:
    """Return the energies <u_i^2>/2 of the three components under the names energy_x, energy_y and energy_z."""
    halves = np.array([0.5 * np.sum(grid.multiplicity * _squared(grid, component[None]), dtype=float)
                       for component in velocity])
    total = global_sum(grid.decomposition.comm, halves)
    return {f"energy_{axis}": float(energy) for axis, energy in zip("xyz", total)}


def _squared(grid: SpectralGrid, velocity: np.ndarray) -> np.ndarray:
    """Return |u(k)|^2 (kz, ky, kx) of modes (c, kz, ky, kx), without the zeroth mode."""
    return (np.abs(velocity) ** 2).sum(axis=0) * (grid.index_squared > 0)


def turbulence_scales(spectrum: np.ndarray, dissipation_rate: float, viscosity: float, cutoff: int) -> dict[str, float]:
    """Return `derived_scales` from E(k), the dissipation rate and the viscosity.

    u'^2 = 2/3 sum E(k), L = pi/(2u'^2) sum E(k)/k (Pope 2000, chapter 6). `cutoff` is the largest wavenumber of the
    grid. The side of the box is 2 pi, so that wavenumbers are integers.
    """
    energy = spectrum.sum()
    u_rms = np.sqrt(2 * energy / 3)
    k = np.arange(1, len(spectrum))
    integral_scale = np.pi / (2 * u_rms**2) * np.sum(spectrum[1:] / k) if energy > 0 else 0.0
    return derived_scales(u_rms, integral_scale, dissipation_rate, viscosity, cutoff)


def derived_scales(u_rms: float, integral_scale: float, dissipation_rate: float, viscosity: float,
                   cutoff: int) -> dict[str, float]:
    """Return scales of isotropic turbulence from u', the integral scale L, the dissipation rate eps and the viscosity
    nu.

    T = L/u', lambda = sqrt(15 nu u'^2/eps), Re_lambda = u' lambda/nu, eta = (nu^3/eps)^(1/4), t_eta = sqrt(nu/eps)
    (Pope 2000, chapter 6). If nu or eps is 0, viscous scales are 0 or inf. `cutoff` is the largest wavenumber of the
    grid.
    """
    nu, eps = viscosity, dissipation_rate
    viscous = nu > 0 and eps > 0
    taylor_scale = np.sqrt(15 * nu * u_rms**2 / eps) if viscous else np.inf
    kolmogorov_length = (nu**3 / eps) ** 0.25 if viscous else 0.0
    return {
        "velocity_rms": u_rms,
        "integral_scale": integral_scale,
        "eddy_turnover_time": integral_scale / u_rms if u_rms > 0 else np.inf,
        "taylor_scale": taylor_scale,
        "reynolds_lambda": u_rms * taylor_scale / nu if viscous else np.inf,
        "kolmogorov_length": kolmogorov_length,
        "kolmogorov_time": np.sqrt(nu / eps) if viscous else np.inf,
        "kmax_eta": cutoff * kolmogorov_length,
    }


def gradient_moments(grid: SpectralGrid, velocity: np.ndarray) -> tuple[float, float]:
    """Return the skewness and the flatness of the velocity gradient, each as the mean over du/dx, dv/dy and dw/dz."""
    def longitudinal(modes: np.ndarray) -> list[np.ndarray]:
        return [(grid.d_dx, modes[1:2]), (grid.d_dy, modes[2:3]), modes[3:]]

    sums = np.zeros((3, 3))
    for gradient in grid.blocks(velocity[[2, 0, 1]], fields=3, expand=longitudinal, z_derivatives=1):
        sums += _powers(gradient)
    return _skewness_and_flatness(global_sum(grid.decomposition.comm, sums) / grid.cells**3)


def _powers(values: np.ndarray) -> np.ndarray:
    """Return the sums of the squares, of the cubes and of the fourth powers, (3, c), of the values of c fields."""
    flat = values.reshape(len(values), -1).astype(float, copy=False)
    squares = flat**2
    return np.stack([squares.sum(axis=1), (squares * flat).sum(axis=1), (squares * squares).sum(axis=1)])


def _skewness_and_flatness(moments: np.ndarray) -> tuple[float, float]:
    """Return the skewness and the flatness, means over c fields, from `moments` (3, c) of order 2, 3 and 4."""
    second, third, fourth = moments
    if not np.all(second > 0):
        return 0.0, 0.0
    return float(np.mean(third / second**1.5)), float(np.mean(fourth / second**2))


def incompressible_budget(grid: SpectralGrid, velocity: np.ndarray, viscosity: float) -> dict[str, float]:
    """Return by name `total_energy`, half the mean square of the whole velocity, and `dissipation_rate`, which is
    nu <|grad u|^2>."""
    squared = (np.abs(velocity) ** 2).sum(axis=0)
    return {"total_energy": 0.5 * grid.sum_modes(squared),
            "dissipation_rate": viscosity * grid.sum_modes(grid.wavenumber_squared * squared)}


def compressible_budget(grid: SpectralGrid, state: np.ndarray, viscosity: float,
                        sound_speed: float) -> dict[str, float]:
    """Return the energy budget of a compressible flow, and more statistics, by name.

    `total_energy` is <rho |v|^2/2 + c^2 (rho ln rho - rho + 1)> with the whole velocity v. Without forcing it decays
    exactly at `dissipation_rate`, nu <rho (2 S:S - 2/3 (div u)^2)>, where S is the rate of strain.
    `compressible_fraction` is the share of <u.u> that belongs to the component of each mode along its wavevector.
    `density_rms` is the rms fluctuation of rho, in units of rho_0. `skewness` and `flatness` are as in
    `gradient_moments`.
    """
    def with_gradients(modes: np.ndarray) -> list[np.ndarray]:
        return [modes[:4], (grid.d_dx, modes[:3]), (grid.d_dy, modes[:3]), modes[4:]]

    sums, powers = np.zeros(4), np.zeros((3, 3))
    for fields in grid.blocks(state, fields=13, expand=with_gradients, z_derivatives=3):
        u, s, A = fields[:3], fields[3], fields[4:].reshape(3, 3, *fields.shape[1:])
        diagonal = np.stack([A[0, 0], A[1, 1], A[2, 2]])
        rho = np.exp(s)
        energy = 0.5 * rho * (u**2).sum(axis=0) + sound_speed**2 * (rho * s - rho + 1)
        shear = sum((A[i, j] + A[j, i]) ** 2 for i, j in ((0, 1), (0, 2), (1, 2)))
        friction = rho * (2 * (diagonal**2).sum(axis=0) + shear - 2 / 3 * diagonal.sum(axis=0) ** 2)
        sums += [part.sum(dtype=float) for part in (energy, friction, rho, rho**2)]
        powers += _powers(diagonal)
    total = global_sum(grid.decomposition.comm, np.concatenate([sums, powers.ravel()])) / grid.cells**3
    along = np.abs(grid.along_wavevector(state[:3])) ** 2 * grid.inverse_squared
    kinetic = grid.sum_modes(_squared(grid, state[:3]))
    skewness, flatness = _skewness_and_flatness(total[4:].reshape(3, 3))
    return {"total_energy": float(total[0]),
            "dissipation_rate": viscosity * float(total[1]),
            "density_rms": float(np.sqrt(max(total[3] - total[2] ** 2, 0.0))),
            "compressible_fraction": grid.sum_modes(along) / kinetic if kinetic > 0 else 0.0,
            "skewness": skewness, "flatness": flatness}
