"""The Gaussian filter of large-eddy simulation."""

from __future__ import annotations

import numpy as np


def gaussian_transfer(wavenumber_squared: np.ndarray, width: float) -> np.ndarray:
    """exp(-k^2 d^2 / 24): Fourier transform of the Gaussian filter of width d, whose second moment is that of a box
    filter of the same width (Pope 2000, Table 13.2)."""
    return np.exp(-np.asarray(wavenumber_squared) * width**2 / 24)
