import numpy as np
import pytest

from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid
from eddies.flow.operators import gradient
from eddies.flow.subgrid import Smagorinsky
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.spectral_grid import SpectralGrid

CONSTANT, WIDTH = 0.2, 0.7


def coarse_grid(comm, cells=16):
    return SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells))


def turbulent_velocity(grid):
    """Solenoidal, with all modes of the grid."""
    return initial_fields.random_velocity(grid, 5, 1.0, 3.0)


def power(grid, velocity, force):
    """Mean of u.f."""
    return grid.sum_modes((velocity.conj() * force).real.sum(axis=0))


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("component", range(3))
@pytest.mark.parametrize("direction", range(3))
def test_force_on_a_sine_is_its_fourier_series(comm, component, direction):
    """u_i = sin x_j: 2 nu_t S_ij = l^2 |cos x_j| cos x_j if i != j, and 2 2^(1/2) times that if i = j.

    |cos| cos is a sum of -8 sin(k pi/2) / (pi k (k^2 - 4)) cos kx over odd k.
    """
    grid = coarse_grid(comm, 32)
    velocity = np.zeros((3, *grid.physical_shape))
    velocity[component] = np.sin(grid.coordinates()[direction])
    velocity, force = grid.forward(velocity), np.zeros((3, *grid.spectral_shape), complex)
    Smagorinsky(grid, CONSTANT, WIDTH).add(velocity, force)
    physical = grid.backward(force)
    amplitude = (CONSTANT * WIDTH) ** 2 * (2 * np.sqrt(2) if component == direction else 1)
    for k in (1, 3):
        expected = amplitude * 8 * np.sin(k * np.pi / 2) / (np.pi * (k**2 - 4))
        found = 2 * grid.mean(physical * np.sin(k * grid.coordinates()[direction]))
        # The series is cut off by the grid, where its terms have fallen to 1/k^3.
        assert found[component] == pytest.approx(expected, abs=3e-4 * amplitude)
        assert np.abs(np.delete(found, component)).max() < 1e-12


@pytest.mark.mpi(1, 2, 3)
def test_it_takes_the_energy_that_the_stress_dissipates(comm):
    grid = coarse_grid(comm)
    velocity, force = turbulent_velocity(grid), np.zeros((3, *grid.spectral_shape), complex)
    Smagorinsky(grid, CONSTANT, WIDTH).add(velocity, force)
    A = np.array([grid.backward(gradient(grid, component)) for component in velocity])
    S = (A + A.transpose(1, 0, 2, 3, 4)) / 2
    squared = np.einsum("ijzyx,ijzyx->zyx", S, S)
    dissipation = grid.mean((2 * (CONSTANT * WIDTH) ** 2 * np.sqrt(2 * squared) * squared)[None])[0]
    assert dissipation > 0.1
    assert power(grid, velocity, force) == pytest.approx(-dissipation, rel=1e-12)
    assert np.abs(force[:, grid.index_squared == 0]).max(initial=0) < 1e-15


@pytest.mark.mpi(1)
def test_it_is_added_to_the_velocity_of_the_fluid_alone(comm):
    grid = coarse_grid(comm)
    velocity = turbulent_velocity(grid)
    state = np.concatenate([velocity, initial_fields.balanced_density(grid, velocity, 8.0)[None]])
    model, force = Smagorinsky(grid, CONSTANT, WIDTH), np.zeros_like(velocity)
    model.add(velocity, force)
    with_model, without = (CompressibleFluid(grid, 0.05, 8.0, None, subgrid).nonlinear(state)
                           for subgrid in (model, None))
    assert np.abs(with_model[:3] - without[:3] - force).max() < 1e-14
    assert np.array_equal(with_model[3], without[3])
