import numpy as np
import pytest

from eddies.flow import initial_fields
from eddies.flow.statistics import energy_spectrum
from eddies.spectral.spectral_grid import regrid
from tests.validation.flows import make_grid


@pytest.mark.mpi(1, 2)
def test_random_field_is_solenoidal_real_and_has_its_spectrum(comm):
    grid = make_grid(comm, 24)
    velocity = initial_fields.random_velocity(grid, 5, amplitude=0.7, peak_wavenumber=3.0)
    assert np.abs(grid.divergence(velocity)).max(initial=0) < 1e-15
    assert np.abs(grid.forward(grid.backward(velocity)) - velocity).max(initial=0) < 1e-15
    spectrum = energy_spectrum(grid, velocity)
    k = np.arange(len(spectrum))
    shape = k**4 * np.exp(-2 * (k / 3.0) ** 2)
    assert spectrum.sum() == pytest.approx(1.5 * 0.7**2, rel=1e-12)
    assert np.allclose(spectrum[:8] / spectrum[3], shape[:8] / shape[3], rtol=1e-12)


@pytest.mark.mpi(1, 2)
def test_a_field_of_a_given_spectrum_has_it_between_its_wavenumbers(comm):
    """Interpolated in logarithms, so exact for a power law, and zero beyond."""
    grid, given = make_grid(comm, 24), np.array([1.5, 3.0, 5.5])
    velocity = initial_fields.velocity_of_spectrum(grid, 5, given, 0.3 * given**-2)
    assert np.abs(grid.divergence(velocity)).max(initial=0) < 1e-15
    spectrum = energy_spectrum(grid, velocity)
    assert np.allclose(spectrum[2:6], 0.3 * np.arange(2.0, 6) ** -2, rtol=1e-12)
    assert not spectrum[:2].any() and not spectrum[6:].any()


@pytest.mark.mpi(1)
def test_random_field_does_not_depend_on_the_resolution(comm):
    coarse, fine = make_grid(comm, 24), make_grid(comm, 36)
    velocities = [initial_fields.random_velocity(grid, 5, 1.0, 1.5) for grid in (coarse, fine)]
    # Shells beyond the coarse cutoff hold almost no energy, so the common normalisation hardly differs.
    inner = np.sqrt(coarse.index_squared) < coarse.cutoff
    difference = regrid(fine, coarse, velocities[1]) - velocities[0]
    assert np.abs(difference[:, inner]).max() < 1e-6


@pytest.mark.mpi(1, 2)
def test_pressure_of_the_taylor_green_vortex(comm):
    grid = make_grid(comm, 16)
    x, y, z = grid.coordinates()
    exact = (np.cos(2 * x) + np.cos(2 * y)) * (np.cos(2 * z) + 2) / 16
    pressure = initial_fields.balanced_density(grid, initial_fields.taylor_green(grid, 1.0), 1.0)
    assert np.abs(grid.backward(pressure[None])[0] - exact).max(initial=0) < 1e-15
