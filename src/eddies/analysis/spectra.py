"""Energy spectra and spectral derivatives of real periodic fields on the cube [0, 2 pi)^3."""

import numpy as np

from eddies.analysis.errors import rms_log_ratio


def energy_spectrum(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shell-summed kinetic energy spectrum: E(k) = 1/2 sum |u_hat|^2 over k - 1/2 <= |k| < k + 1/2.

    velocity: (3, n, n, n) real, the box is 2 pi, so wavenumbers are integers. Returns (wavenumber, energy),
    both (shells,), from k = 0 to the corner of the spectral cube: the sum of E(k) is 1/2 <u.u> to rounding
    (Parseval). Raises ValueError if the field is not cubic.
    """
    _require_cube(velocity)
    cells = velocity.shape[-1]
    shell = np.rint(np.sqrt(_squared_wavenumber(cells))).astype(np.int64).ravel()
    mode_energy = np.zeros(shell.size)
    for component in velocity:
        mode_energy += 0.5 * np.abs(np.fft.rfftn(np.asarray(component, dtype=float)).ravel() / cells**3) ** 2
    mode_energy *= _conjugate_weight(cells).ravel()
    energy = np.bincount(shell, weights=mode_energy)
    return np.arange(energy.size, dtype=float), energy


def spectrum_error(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> float:
    """Root mean square of ln(E(k) / E_reference(k)) over the shells k = 1, 2, ... <= largest_wavenumber, at least the
    first: every scale counts alike, and a factor e^a in all of them is an error of a.

    energy and reference: (shells,) from k = 0 on, as many of one as of the other. Not finite where a shell of either is
    empty.
    """
    shells = _shells(largest_wavenumber)
    return rms_log_ratio(energy[shells], reference[shells])


def band_ratios(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> dict[str, float]:
    """Energy over that of the reference by bands of shells, 1-2, 3-4, 5-8, 9-16, ... <= largest_wavenumber, the last
    one cut off there; spectra as for `spectrum_error`."""
    last, ratios, first, end = _shells(largest_wavenumber).stop - 1, {}, 1, 2
    while first <= last:
        end = min(end, last)
        band = slice(first, end + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios[f"{first}-{end}" if end > first else f"{first}"] = float(energy[band].sum() / reference[band].sum())
        first, end = end + 1, 2 * end
    return ratios


def _shells(largest_wavenumber: float) -> slice:
    return slice(1, max(int(largest_wavenumber + 1e-9), 1) + 1)


def vorticity(velocity: np.ndarray) -> np.ndarray:
    """Vorticity curl u by spectral differentiation: (3, n, n, n) -> (3, n, n, n), components x, y, z.

    Derivatives of the Nyquist modes are set to zero, as a real field requires.
    """
    _require_cube(velocity)
    cells = velocity.shape[-1]
    kz, ky, kx = (1j * k for k in _derivative_wavenumbers(cells))
    u, v, w = (np.fft.rfftn(np.asarray(component, dtype=float)) for component in velocity)
    curl = (ky * w - kz * v, kz * u - kx * w, kx * v - ky * u)
    return np.stack([np.fft.irfftn(component, s=(cells,) * 3, axes=(0, 1, 2)) for component in curl])


def _require_cube(velocity: np.ndarray) -> None:
    if velocity.ndim != 4 or velocity.shape[0] != 3 or len(set(velocity.shape[1:])) != 1:
        raise ValueError(f"a velocity field has shape (3, n, n, n), not {velocity.shape}")


def _wavenumbers(cells: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    full = np.fft.fftfreq(cells, 1 / cells)
    half = np.arange(cells // 2 + 1, dtype=float)
    return full[:, None, None], full[None, :, None], half[None, None, :]


def _derivative_wavenumbers(cells: int) -> tuple[np.ndarray, ...]:
    return tuple(np.where(2 * np.abs(k) == cells, 0, k) for k in _wavenumbers(cells))


def _squared_wavenumber(cells: int) -> np.ndarray:
    kz, ky, kx = _wavenumbers(cells)
    return kz**2 + ky**2 + kx**2


def _conjugate_weight(cells: int) -> np.ndarray:
    """2 where the real transform holds one of a pair of conjugate modes, 1 on the planes that hold both."""
    kx = np.arange(cells // 2 + 1)
    weight = np.where((kx == 0) | (2 * kx == cells), 1.0, 2.0)
    return np.broadcast_to(weight, (cells, cells, kx.size))
