"""Initial states: random solenoidal turbulence, and flows with known solutions. Fields are modes (c, kz, ky, kx)."""

import math

import numpy as np

from eddies.flow.statistics import energy_spectrum
from eddies.spectral.spectral_grid import SpectralGrid


def random_velocity(grid: SpectralGrid, seed: int, amplitude: float, peak_wavenumber: float) -> np.ndarray:
    """Return a Gaussian solenoidal velocity (3, kz, ky, kx) with the spectrum E(k) ~ k^4 exp(-2 (k / k_p)^2).

    k_p is `peak_wavenumber`, and `amplitude` is the rms of one component. Every shell of modes has exactly the energy
    of this spectrum. Each line of modes along kx has its own generator, seeded by (seed, ky, kz), so that the field
    depends neither on the number of ranks nor on the resolution.
    """
    velocity, energy = _gaussian_solenoidal(grid, seed)
    k = np.arange(len(energy))
    target = k**4 * np.exp(-2 * (k / peak_wavenumber) ** 2)
    return _with_spectrum(grid, velocity, energy, target * 1.5 * amplitude**2 / target[energy > 0].sum())


def velocity_of_spectrum(grid: SpectralGrid, seed: int, wavenumber: np.ndarray, energy: np.ndarray) -> np.ndarray:
    """Return a Gaussian solenoidal velocity (3, kz, ky, kx) with a given spectrum E(k).

    E has the values `energy` at the ascending values `wavenumber`. ln E is linear in ln k between them, and E is zero
    outside their range. The random numbers are those of `random_velocity`.
    """
    velocity, present = _gaussian_solenoidal(grid, seed)
    given = energy > 0
    target, k = np.zeros(len(present)), np.arange(1, len(present))
    target[1:] = np.exp(np.interp(np.log(k), np.log(wavenumber[given]), np.log(energy[given]), -np.inf, -np.inf))
    return _with_spectrum(grid, velocity, present, target)


def _gaussian_solenoidal(grid: SpectralGrid, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return normally distributed modes of a solenoidal velocity with zero mean, and the spectrum of this velocity."""
    velocity = grid.solenoidal(_gaussian_modes(grid, seed))
    velocity[:, grid.index_squared == 0] = 0
    return velocity, energy_spectrum(grid, velocity)


def _with_spectrum(grid: SpectralGrid, velocity: np.ndarray, energy: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Scale each shell of modes so that the spectrum `energy` of the velocity becomes `target`; return the result."""
    scale = np.sqrt(np.divide(target, energy, out=np.zeros(len(energy)), where=energy > 0))
    return (velocity * scale[grid.shell_number]).astype(grid.complex)


def _gaussian_modes(grid: SpectralGrid, seed: int) -> np.ndarray:
    """Return normally distributed complex numbers (3, kz, ky, kx); those of the modes k and -k are conjugate."""
    def line(ky: int, kz: int) -> np.ndarray:
        # Negative wavenumbers are folded to odd numbers, because seeds must not be negative.
        fold = [2 * k if k >= 0 else -2 * k - 1 for k in (ky, kz)]
        numbers = np.random.default_rng([seed, *fold]).standard_normal((grid.cutoff + 1, 3, 2))
        return (numbers[..., 0] + 1j * numbers[..., 1]).T

    modes = np.empty((3, *grid.spectral_shape), complex)
    for column, ky in enumerate(grid.index[1].ravel()):
        for row, kz in enumerate(grid.index[2].ravel()):
            modes[:, row, column] = line(ky, kz)
            if (ky, kz) < (0, 0):
                modes[:, row, column, 0] = line(-ky, -kz)[:, 0].conj()
    return modes


def taylor_green(grid: SpectralGrid, amplitude: float) -> np.ndarray:
    """Return the Taylor-Green vortex, amplitude (sin x cos y cos z, -cos x sin y cos z, 0).

    Its energy is amplitude^2 / 8.
    """
    x, y, z = grid.coordinates()
    u = np.sin(x) * np.cos(y) * np.cos(z)
    v = -np.cos(x) * np.sin(y) * np.cos(z)
    return _modes(grid, amplitude, [u, v, 0.0])


def abc(grid: SpectralGrid, amplitude: float, wavenumber: int) -> np.ndarray:
    """Return the Arnold-Beltrami-Childress flow with A = B = C = amplitude and the wavenumber k.

    Its vorticity is k times its velocity, so that the flow decays as exp(-nu k^2 t).
    """
    x, y, z = (wavenumber * axis for axis in grid.coordinates())
    return _modes(grid, amplitude, [np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)])


def shear_wave(grid: SpectralGrid, amplitude: float, wavenumber: int) -> np.ndarray:
    """Return u_x = amplitude sin(k y), an exact solution of both fluids that decays as exp(-nu k^2 t)."""
    _, y, _ = grid.coordinates()
    return _modes(grid, amplitude, [np.sin(wavenumber * y), 0.0, 0.0])


def sound_wave_density(grid: SpectralGrid, amplitude: float, wavenumber: int) -> np.ndarray:
    """Return the modes (kz, ky, kx) of ln(rho / rho_0) = amplitude cos(k x), a standing sound wave from rest."""
    x, _, _ = grid.coordinates()
    return _modes(grid, amplitude, [np.cos(wavenumber * x)])[0]


def balanced_density(grid: SpectralGrid, velocity: np.ndarray, sound_speed: float) -> np.ndarray:
    """Return the modes (kz, ky, kx) of s = p / c^2, where p is the pressure of the incompressible flow.

    A flow with this initial s = ln(rho / rho_0) emits almost no sound.
    """
    return grid.pressure_of(grid.squares(velocity)) / sound_speed**2


#: Functions that return the initial velocity, by [initial] kind. Their arguments are grid, section [initial] and seed.
INITIAL_FLOWS = {
    "random": lambda grid, initial, seed: random_velocity(grid, seed, initial.amplitude, initial.peak_wavenumber),
    "taylor-green": lambda grid, initial, seed: taylor_green(grid, initial.amplitude),
    "abc": lambda grid, initial, seed: abc(grid, initial.amplitude, initial.wavenumber),
    "shear-wave": lambda grid, initial, seed: shear_wave(grid, initial.amplitude, initial.wavenumber),
    "sound-wave": lambda grid, initial, seed: np.zeros((3, *grid.spectral_shape), grid.complex),
}
#: The root mean square of the speed, and the largest sum of the magnitudes of the three velocity components (None: it
#: is random), both divided by the amplitude, by [initial] kind.
SPEEDS = {"random": (math.sqrt(3), None), "taylor-green": (0.5, 1.0), "abc": (math.sqrt(3), 3 * math.sqrt(2)),
          "shear-wave": (math.sqrt(0.5), 1.0)}


def _modes(grid: SpectralGrid, amplitude: float, components: list) -> np.ndarray:
    """Return `amplitude` times the modes of a field whose `components` are values at the grid points."""
    field = np.stack([np.broadcast_to(np.asarray(c, grid.real), grid.physical_shape) for c in components])
    return grid.forward(amplitude * field)
