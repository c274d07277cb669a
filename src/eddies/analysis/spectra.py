"""Energy spectra and vorticity of real periodic fields on the cube [0, 2 pi)^3."""

import numpy as np

from eddies.analysis.errors import rms_log_ratio


def energy_spectrum(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Energy by shells, E(k) = 1/2 sum |u_hat|^2 over k - 1/2 <= |k| < k + 1/2, of a velocity (3, n, n, n).

    Returns wavenumber and energy, both (shells,), from k = 0 to the corner of the spectral cube: the sum of E(k) is
    <u.u>/2 (Parseval). Raises ValueError if the field is not cubic.
    """
    kz, ky, kx = _wavenumbers(velocity)
    cells = velocity.shape[-1]
    shell = np.rint(np.sqrt(kz**2 + ky**2 + kx**2)).astype(np.int64).ravel()
    mode_energy = np.zeros(shell.size)
    for component in velocity:
        mode_energy += 0.5 * np.abs(np.fft.rfftn(np.asarray(component, dtype=float)).ravel() / cells**3) ** 2
    # The real transform holds one of each two conjugate modes, but both on the planes kx = 0 and kx = n / 2.
    conjugates = np.where((kx == 0) | (2 * kx == cells), 1.0, 2.0)
    mode_energy *= np.broadcast_to(conjugates, (cells, cells, kx.size)).ravel()
    energy = np.bincount(shell, weights=mode_energy)
    return np.arange(energy.size, dtype=float), energy


def spectrum_error(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> float:
    """Root mean square of ln(E(k) / E_reference(k)) over the shells 1 <= k <= largest_wavenumber, at least the first.

    energy and reference: (shells,), from k = 0 on. Not finite if a shell of either is empty.
    """
    shells = slice(1, _last_shell(largest_wavenumber) + 1)
    return rms_log_ratio(energy[shells], reference[shells])


def band_ratios(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> dict[str, float]:
    """Ratio of energies in the bands of shells 1-2, 3-4, 5-8, 9-16, ... up to largest_wavenumber, by name."""
    last, ratios, first, end = _last_shell(largest_wavenumber), {}, 1, 2
    while first <= last:
        end = min(end, last)
        band = slice(first, end + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios[f"{first}-{end}" if end > first else f"{first}"] = float(energy[band].sum() / reference[band].sum())
        first, end = end + 1, 2 * end
    return ratios


def _last_shell(largest_wavenumber: float) -> int:
    return max(int(largest_wavenumber + 1e-9), 1)


def vorticity(velocity: np.ndarray) -> np.ndarray:
    """Vorticity curl u by spectral differentiation: (3, n, n, n) -> (3, n, n, n), components x, y, z.

    Derivatives of the Nyquist modes are set to zero, as a real field requires.
    """
    cells = velocity.shape[-1]
    kz, ky, kx = (1j * np.where(2 * np.abs(k) == cells, 0, k) for k in _wavenumbers(velocity))
    u, v, w = (np.fft.rfftn(np.asarray(component, dtype=float)) for component in velocity)
    curl = (ky * w - kz * v, kz * u - kx * w, kx * v - ky * u)
    return np.stack([np.fft.irfftn(component, s=(cells,) * 3, axes=(0, 1, 2)) for component in curl])


def _wavenumbers(velocity: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """kz, ky and kx >= 0 of the modes of a field, broadcast over (kz, ky, kx)."""
    if velocity.ndim != 4 or velocity.shape[0] != 3 or len(set(velocity.shape[1:])) != 1:
        raise ValueError(f"a velocity field has shape (3, n, n, n), not {velocity.shape}")
    cells = velocity.shape[-1]
    full = np.fft.fftfreq(cells, 1 / cells)
    return full[:, None, None], full[None, :, None], np.arange(cells // 2 + 1, dtype=float)[None, None, :]
