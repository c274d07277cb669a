"""Operators on modes, against known derivatives; the same for arrays and tensors."""

import numpy as np
import pytest
import torch

from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.mode_operators import ModeOperators, gaussian_transfer, rising
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH = 5.0
pytestmark = pytest.mark.mpi(1)


@pytest.fixture
def grid(comm):
    return SpectralGrid(SlabDecomposition(comm, LENGTH, 14))


def modes(grid, components):
    random = np.random.default_rng(components)
    return grid.forward(random.standard_normal((components, *grid.physical_shape)))


def test_operators_on_a_wave_with_known_derivatives(grid):
    """u = sin(k x) (0, 1, 2) + cos(2 k y) (1, 3, 0), whose second part has a divergence."""
    k = 2 * np.pi / LENGTH
    x, y, _ = grid.coordinates()
    first, second = (np.broadcast_to(wave, grid.physical_shape) for wave in (np.sin(k * x), np.cos(2 * k * y)))
    velocity = grid.forward(np.stack([second, first + 3 * second, 2 * first]))
    divergence = -6 * k * np.sin(2 * k * y)
    assert np.abs(grid.backward(grid.divergence(velocity)[None])[0] - divergence).max() < 1e-13
    solenoidal = np.stack([second, first, 2 * first])
    assert np.abs(grid.backward(grid.solenoidal(velocity)) - solenoidal).max() < 1e-14
    slopes = grid.backward(grid.gradient(velocity[0]))
    assert np.abs(slopes[1] + 2 * k * np.sin(2 * k * y)).max() < 1e-13 and np.abs(slopes[[0, 2]]).max() < 1e-13


def test_a_stress_with_its_pressure_is_solenoidal(grid):
    stress = modes(grid, 6)
    divergence, pressure = grid.stress_divergence(stress), grid.pressure_of(stress)
    force = divergence + grid.gradient(pressure)
    assert np.abs(grid.divergence(force)).max() < 1e-13 * np.abs(divergence).max() and pressure[0, 0, 0] == 0
    assert np.abs(force - grid.solenoidal(divergence)).max() < 1e-14 * np.abs(divergence).max()


@pytest.mark.parametrize("name, components", [("gradient", 0), ("divergence", 3), ("solenoidal", 3),
                                              ("stress_divergence", 6), ("pressure_of", 6)])
def test_tensors_give_what_arrays_give(grid, name, components):
    by_tensors = ModeOperators(map(torch.from_numpy, grid.wavevector), torch.from_numpy(grid.wavenumber_squared),
                               torch.stack)
    given = modes(grid, components) if components else modes(grid, 1)[0]
    found = getattr(by_tensors, name)(torch.from_numpy(given))
    # Compilers may fuse products and sums.
    expected = getattr(grid, name)(given)
    assert np.abs(found.numpy() - expected).max() <= 1e-15 * np.abs(expected).max()


def test_rates_are_linear_between_wavenumbers_and_differentiable(grid):
    shell, rates = np.sqrt(grid.index_squared), np.array([0.2, 1.5, -0.3])
    expected = np.interp(shell, np.linspace(0, 3.6, 4), [0, *rates])
    assert np.abs(rising(shell, 3.6, rates) - expected).max() < 1e-15
    given = torch.from_numpy(rates).requires_grad_()
    found = rising(torch.from_numpy(shell), 3.6, given)
    assert np.abs(found.detach().numpy() - expected).max() < 1e-15
    weights = torch.linspace(0.1, 1, found.numel(), dtype=torch.float64).reshape(found.shape)
    slopes, = torch.autograd.grad((weights * found).sum(), given)
    for number, unit in enumerate(torch.eye(3, dtype=torch.float64)):
        expected = (weights * rising(torch.from_numpy(shell), 3.6, unit)).sum()
        assert float(slopes[number]) == pytest.approx(float(expected))


def test_the_filter_has_the_second_moment_of_a_box_of_its_width(comm):
    """The transfer of a box of width d is sin(x) / x, x = k d / 2. The Gaussian differs from it by
    (1/1152 - 1/1920) (k d)^4; with another second moment it would differ in (k d)^2."""
    width, k = 0.7, np.array([0.05, 0.1, 0.2, 0.4])
    box = np.sinc(k * width / (2 * np.pi))
    assert np.all(np.abs(gaussian_transfer(k**2, width) - box) < 4e-4 * (k * width) ** 4)
    assert gaussian_transfer(4.0, 0.0) == 1
