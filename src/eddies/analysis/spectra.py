"""Errors of energy spectra, and the vorticity of real periodic fields on the cube [0, 2 pi)^3."""

import numpy as np

from eddies.analysis.errors import rms_log_ratio


def spectrum_error(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> float:
    """Return the root mean square of ln(E(k) / E_reference(k)) over the shells 1 <= k <= largest_wavenumber.

    `energy` and `reference` are (shells,), from k = 0 on. The shell k = 1 always counts. If the last shell has
    k < largest_wavenumber, the mean ends there. The result is not finite if one of these shells has no energy in
    `energy` or in `reference`.
    """
    shells = slice(1, _last_shell(largest_wavenumber, energy) + 1)
    return rms_log_ratio(energy[shells], reference[shells])


def band_ratios(energy: np.ndarray, reference: np.ndarray, largest_wavenumber: float) -> dict[str, float]:
    """Return, for each of the bands of shells "1-2", "3-4", "5-8", ..., its energy divided by that in `reference`.

    All bands together have the shells of `spectrum_error`, so the last band may be narrower.
    """
    last, ratios, first, end = _last_shell(largest_wavenumber, energy), {}, 1, 2
    while first <= last:
        end = min(end, last)
        band = slice(first, end + 1)
        with np.errstate(divide="ignore", invalid="ignore"):
            ratios[f"{first}-{end}" if end > first else f"{first}"] = float(energy[band].sum() / reference[band].sum())
        first, end = end + 1, 2 * end
    return ratios


def _last_shell(largest_wavenumber: float, energy: np.ndarray) -> int:
    return min(max(int(largest_wavenumber + 1e-9), 1), len(energy) - 1)


def vorticity(velocity: np.ndarray) -> np.ndarray:
    """Return the vorticity curl u of a velocity u by spectral differentiation: (3, n, n, n) -> (3, n, n, n).

    Components are x, y, z. Derivatives of the Nyquist modes are set to zero, as a real field requires.
    """
    cells = velocity.shape[-1]
    k = np.fft.fftfreq(cells, 1 / cells)
    k[2 * np.abs(k) == cells] = 0
    kz, ky, kx = 1j * k[:, None, None], 1j * k[:, None], 1j * np.abs(k[:cells // 2 + 1])
    u, v, w = (np.fft.rfftn(np.asarray(component, dtype=float)) for component in velocity)
    curl = (ky * w - kz * v, kz * u - kx * w, kx * v - ky * u)
    return np.stack([np.fft.irfftn(component, s=(cells,) * 3, axes=(0, 1, 2)) for component in curl])
