from types import SimpleNamespace

import numpy as np
import pytest
import torch

from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.subgrid import DynamicStress, EddyDamping, SpectralViscosity, StressModel
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.resolved_velocity import ResolvedFlow
from eddies.particles.terms.resolved_forces import Damping
from eddies.spectral.mode_operators import gaussian_transfer
from tests.validation.flows import make_grid, march, with_density

LENGTH = 0.14  # the mixing length of Smagorinsky's model
DYNAMIC = pytest.mark.parametrize("width, with_gradient", [(0.0, False), (0.8, True)])


@pytest.fixture(scope="module")
def grid(comm):
    return make_grid(comm, 24)


@pytest.fixture(scope="module")
def velocity(grid):
    """Random and solenoidal, with all modes of the grid."""
    return initial_fields.random_velocity(grid, 5, 1.0, 3.0)


def force_of(model, velocity):
    force = np.zeros_like(velocity)
    model.begin_step(velocity)
    model.add(velocity, force)
    return force


def power(grid, velocity, force):
    """Mean of u.f."""
    return grid.sum_modes((velocity.conj() * force).real.sum(axis=0))


@pytest.mark.mpi(3)
@pytest.mark.parametrize("component, direction", [(2, 2), (0, 1), (2, 0), (1, 2)])
def test_force_on_a_sine_is_its_fourier_series(comm, component, direction):
    """u_i = sin x_j: 2 nu_t S_ij = l^2 |cos x_j| cos x_j if i != j, and 2 2^(1/2) times that if i = j.

    |cos| cos is a sum of -8 sin(k pi/2) / (pi k (k^2 - 4)) cos kx over odd k.
    """
    grid = make_grid(comm, 32)
    velocity = np.zeros((3, *grid.physical_shape))
    velocity[component] = np.sin(grid.coordinates()[direction])
    physical = grid.backward(force_of(StressModel(grid, LENGTH), grid.forward(velocity)))
    amplitude = LENGTH**2 * (2 * np.sqrt(2) if component == direction else 1)
    for k in (1, 3):
        expected = amplitude * 8 * np.sin(k * np.pi / 2) / (np.pi * (k**2 - 4))
        found = 2 * grid.mean(physical * np.sin(k * grid.coordinates()[direction]))
        # The grid cuts the series off where its terms have fallen to 1/k^3.
        assert found[component] == pytest.approx(expected, abs=3e-4 * amplitude)
        assert np.abs(np.delete(found, component)).max() < 1e-12


@pytest.mark.mpi(2)
def test_it_takes_the_energy_that_the_stress_dissipates(grid, velocity):
    force = force_of(StressModel(grid, LENGTH), velocity)
    A = np.array([grid.backward(grid.gradient(component)) for component in velocity])
    S = (A + A.transpose(1, 0, 2, 3, 4)) / 2
    squared = np.einsum("ijzyx,ijzyx->zyx", S, S)
    dissipation = grid.mean((2 * LENGTH**2 * np.sqrt(2 * squared) * squared)[None])[0]
    assert dissipation > 0.1
    assert power(grid, velocity, force) == pytest.approx(-dissipation, rel=1e-12)
    assert np.abs(force[:, grid.index_squared == 0]).max(initial=0) < 1e-15


@pytest.mark.mpi(1)
def test_a_closure_acts_on_the_velocity_alone_and_keeps_an_incompressible_one_solenoidal(grid, velocity):
    model, state = StressModel(grid, LENGTH), with_density(grid, velocity, 8.0)
    force = force_of(model, velocity)
    with_model, without = (CompressibleFluid(grid, 0.05, 8.0, None, closure).nonlinear(state)
                           for closure in (model, None))
    assert np.abs(with_model[:3] - without[:3] - force).max() < 1e-14
    assert np.array_equal(with_model[3], without[3])
    with_model, without = (IncompressibleFluid(grid, 0.05, closure=closure).nonlinear(velocity)
                           for closure in (model, None))
    assert np.abs(with_model - without - grid.solenoidal(force)).max() < 1e-14


def hidden_stress(grid, velocity, width):
    """The stress that a filter hides: G(uu) - (Gu)(Gu), six rows."""
    transfer = gaussian_transfer(grid.wavenumber_squared, width)
    return transfer * grid.squares(velocity) - grid.squares(transfer * velocity)


@pytest.mark.mpi(1)
def test_gradient_stress_is_the_hidden_one_to_fourth_order_in_the_filter_width(grid):
    velocity = initial_fields.random_velocity(grid, 5, 1.0, 2.0)
    # Products of these modes fit on the grid, so that only the expansion in the width is left.
    velocity[:, grid.index_squared > 12] = 0
    errors = []
    for width in (0.2, 0.1):
        filtered = gaussian_transfer(grid.wavenumber_squared, width) * velocity
        exact = hidden_stress(grid, velocity, width)
        difference = StressModel(grid, filter_width=width).stress(filtered) - exact
        errors.append(np.linalg.norm(difference) / np.linalg.norm(exact))
    # The stress is of second order, the error of fourth.
    assert errors[0] < 0.02 and errors[0] / errors[1] == pytest.approx(4, rel=0.1)


@pytest.fixture(scope="module")
def developed(grid):
    """A flow that has had time to send energy to its smallest scales."""
    return march(IncompressibleFluid(grid, 0.02), initial_fields.random_velocity(grid, 5, 1.0, 2.0), 0.06, 20)


@pytest.mark.mpi(1)
@DYNAMIC
def test_a_dynamic_coefficient_follows_the_way_that_energy_goes(grid, velocity, developed, width, with_gradient):
    """It is positive where energy goes to smaller scales. It is 0 in the same flow run backwards, in random modes,
    between which no energy passes, and in a laminar shear."""
    model, lengths = DynamicStress(grid, width, with_gradient), []
    transfer = gaussian_transfer(grid.wavenumber_squared, width)
    for flow in (developed, -developed, velocity, initial_fields.shear_wave(grid, 1.0, 1)):
        model.begin_step(transfer * flow)
        lengths.append(np.sqrt(model.squared_length))
    constant = lengths[0] / (width or np.pi / grid.cutoff)
    # The gradient part takes over most of what a viscosity would do.
    assert (0.02 if with_gradient else 0.08) < constant < 0.25
    assert lengths[1] == 0 and lengths[2] < 0.4 * lengths[0] and lengths[3] < 1e-3 * lengths[0]


@pytest.mark.mpi(2)
@DYNAMIC
def test_a_dynamic_coefficient_is_found_where_the_hidden_stress_is_the_models(
        grid, velocity, monkeypatch, width, with_gradient):
    """The stress between the two filters is made of the same model for either width. The squares of widths of Gaussian
    filters add up, and a cut-off at half the wavenumber is twice as wide."""
    mixing_length = 0.13
    model = DynamicStress(grid, width, with_gradient)
    if width:
        test = gaussian_transfer(grid.wavenumber_squared, 2 * width)
        wider = np.sqrt(width**2 + (2 * width) ** 2) / width
    else:
        below = [np.abs(axis) <= grid.cutoff // 2 for axis in grid.index]
        test, wider = below[0] & below[1] & below[2], grid.cutoff / (grid.cutoff // 2)
    of_gradient = width if with_gradient else 0.0
    fine, coarse = (StressModel(grid, scale * mixing_length, scale * of_gradient) for scale in (1, wider))
    between = coarse.stress(test * velocity) - test * fine.stress(velocity)
    # Replaces the filtered products u u, and the products of the test-filtered velocity.
    squares = iter([np.zeros_like(between), -between])
    monkeypatch.setattr(grid, "squares", lambda _: next(squares))
    model.begin_step(velocity)
    assert np.sqrt(model.squared_length) == pytest.approx(mixing_length, rel=1e-9)


@pytest.mark.mpi(2)
def test_spectral_viscosity_drains_what_an_inertial_range_brings(comm):
    """With E = 1.4 eps^(2/3) k^(-5/3) up to the cut-off it dissipates eps; the sum over shells replaces an integral. A
    resolved flow, without energy at the cut-off, loses nothing."""
    grid, dissipation = make_grid(comm, 48), 0.7
    k = np.arange(1.0, grid.cutoff + 1)
    velocity = initial_fields.velocity_of_spectrum(grid, 5, k, 1.4 * dissipation ** (2 / 3) * k ** (-5 / 3))
    force = force_of(SpectralViscosity(grid), velocity)
    assert -power(grid, velocity, force) == pytest.approx(dissipation, rel=0.1)
    resolved = initial_fields.random_velocity(grid, 5, 1.0, 2.0)
    assert abs(power(grid, resolved, force_of(SpectralViscosity(grid), resolved))) < 1e-12


@pytest.mark.mpi(2)
def test_learned_damping_is_that_of_the_particle_model(grid, velocity):
    """In the same flow, which particles resolve up to the same wavenumber."""
    velocity = np.where(grid.index_squared > grid.cutoff**2, 0, velocity)  # particles resolve a ball of modes
    rates = np.array([0.1, 0.3, 0.2, 0.5, 0.4, 0.9])
    force = force_of(EddyDamping(grid, rates), velocity)
    flow = ResolvedFlow(FourierGrid(grid.decomposition, grid.cutoff), torch.zeros(3), torch.from_numpy(velocity), None,
                        None, 0.0)
    term = Damping(Damping.Settings(), None)
    term.load_state_dict({"rates": torch.from_numpy(rates)})
    found = term(SimpleNamespace(resolved=flow, decomposition=grid.decomposition)).force_modes
    assert np.abs(force).max() > 1e-3
    assert np.abs(found.detach().numpy() - force).max() < 1e-15
