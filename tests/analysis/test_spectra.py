import numpy as np
import pytest

from eddies.analysis.spectra import band_ratios, spectrum_error, vorticity


def grid(cells):
    x = 2 * np.pi * np.arange(cells) / cells
    return np.meshgrid(x, x, x, indexing="ij")[::-1]


def test_a_factor_in_every_shell_is_an_error_of_its_logarithm():
    reference = np.array([9.0, 3.0, 0.4, 1e-3, 1e-5, 1e-8])
    for factor in (0.2, -0.2):
        assert spectrum_error(reference * np.exp(factor), reference, 4.7) == pytest.approx(0.2)
    # One of the shells 1 to 3 is wrong by a factor e^3.
    energy = reference * [5, 1, 1, np.exp(3), 0, 7]
    assert spectrum_error(energy, reference, 3.9) == pytest.approx(3 / np.sqrt(3))
    assert spectrum_error(energy, reference, 0.5) == 0 and spectrum_error(energy, reference, 4) == np.inf


def test_bands_double_and_the_last_ends_at_the_largest_wavenumber():
    reference = 1 / np.arange(1, 40.0) ** 2
    energy = reference * np.where(np.arange(39) < 9, 1.0, 2.0)
    found = band_ratios(energy, reference, 20.3)
    assert list(found) == ["1-2", "3-4", "5-8", "9-16", "17-20"]
    assert list(found.values()) == pytest.approx([1, 1, 1, 2, 2])
    assert list(band_ratios(energy, reference, 5.0)) == ["1-2", "3-4", "5"]
    assert list(band_ratios(energy, reference, 0.7)) == ["1"]


@pytest.mark.parametrize("cells", [9, 12])
def test_vorticity_of_an_abc_flow_is_its_velocity(cells):
    x, y, z = grid(cells)
    a, b, c = 1.0, 0.8, 0.6
    flow = np.stack([
        a * np.sin(z) + c * np.cos(y),
        b * np.sin(x) + a * np.cos(z),
        c * np.sin(y) + b * np.cos(x),
    ])
    assert np.allclose(vorticity(flow), flow, atol=1e-13)
