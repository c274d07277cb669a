"""The solver against flows whose evolution is known."""

import numpy as np
import pytest
from flows import amplification, make_grid, march, measured_growth, with_density

from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.statistics import incompressible_budget
from eddies.flow.stability import quadratic_energy
from eddies.parallel.reduction import global_max
from eddies.time_stepping import STEPPERS


def largest(comm, array):
    return float(global_max(comm, np.abs(array).max(initial=0.0)))


@pytest.mark.mpi(2)
@pytest.mark.parametrize("stepper", STEPPERS)
def test_taylor_green_energy(comm, stepper):
    # E(0.1) at Re = 1600 on 32^3, on which public spectral codes agree in all digits.
    grid = make_grid(comm, 32)
    fluid, velocity = IncompressibleFluid(grid, 1 / 1600), initial_fields.taylor_green(grid, 1.0)
    assert quadratic_energy(fluid, velocity) == pytest.approx(0.125, abs=1e-15)
    velocity = march(fluid, velocity, 0.02, 5, stepper)
    assert quadratic_energy(fluid, velocity) == pytest.approx(0.124953117517, abs=1e-9)


@pytest.mark.mpi(1)
def test_taylor_green_dissipation(comm):
    # Re = 1600, against 512^3 cells at t = 2; -0.5 % on 24^3, which hardly resolve the smallest scales.
    grid, nu = make_grid(comm, 24), 1 / 1600
    velocity = march(IncompressibleFluid(grid, nu), initial_fields.taylor_green(grid, 1.0), 0.1, 20)
    assert incompressible_budget(grid, velocity, nu)["dissipation_rate"] == pytest.approx(0.000708, rel=0.01)


@pytest.mark.mpi(2)
def test_abc_flow_decays_exactly(comm):
    grid = make_grid(comm, 16)
    nu, k = 0.05, 2
    start = initial_fields.abc(grid, 1.0, k)
    end = march(IncompressibleFluid(grid, nu), start, 0.05, 20)
    assert largest(comm, end - start * np.exp(-nu * k**2)) < 1e-10


@pytest.mark.mpi(1)
@pytest.mark.parametrize("sound_speed, nu, step", [
    (1.0, 0.02, 0.05),
    (100.0, 0.02, 0.04),  # M_t = 0.01 for unit velocities; c dt / dx = 10
    (3.0, 2.0, 0.05),  # overdamped: the eigenvalues are real
    (3.0, 4.5 / 2, 0.05),  # critically damped: the eigenvalues meet
], ids=["plain", "acoustic CFL 10", "overdamped", "critical"])
def test_linear_sound_wave_frequency_and_decay(comm, sound_speed, nu, step):
    grid, k = make_grid(comm, 16), 2
    state = np.zeros((4, *grid.spectral_shape), complex)
    amplitude = 1e-9  # nonlinear terms are its square
    state[3] = initial_fields.sound_wave_density(grid, amplitude, k)
    count = 25
    end = march(CompressibleFluid(grid, nu, sound_speed), state, step, count)
    t, gamma = step * count, 2 / 3 * nu * k**2
    omega = np.sqrt(complex(sound_speed**2 * k**2 - gamma**2))
    ratio = t if abs(omega) < 1e-9 else (np.sin(omega * t) / omega).real
    exact = np.exp(-gamma * t) * (np.cos(omega * t).real + gamma * ratio)
    assert end[3, 0, 0, k].real * 2 / amplitude == pytest.approx(exact, rel=1e-5, abs=1e-7)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", ["incompressible", "compressible"])
def test_order_in_time(comm, kind):
    grid = make_grid(comm, 12)
    state = initial_fields.random_velocity(grid, 2, 1.0, 2.0)
    fluid = IncompressibleFluid(grid, 0.02)
    if kind == "compressible":
        fluid, state = CompressibleFluid(grid, 0.02, 2.0), with_density(grid, state, 2.0)
    reference = march(fluid, state, 0.4 / 128, 128)
    errors = [np.abs(march(fluid, state, 0.4 / n, n) - reference).max() for n in (8, 16, 32)]
    assert np.log2(errors[0] / errors[1]) > 3.8 and np.log2(errors[1] / errors[2]) > 3.8


@pytest.mark.mpi(1)
@pytest.mark.parametrize("stepper", STEPPERS)
def test_inviscid_energy_is_conserved_at_the_order_of_the_scheme(comm, stepper):
    # The truncated equations conserve energy; what is lost is the scheme's. A step multiplies a wave by
    # |R(i w)|^2 = 1 - w^6 / 72 + ..., so energy is lost at the fifth order of the step.
    grid = make_grid(comm, 15)
    fluid, state = IncompressibleFluid(grid, 0.0), initial_fields.random_velocity(grid, 3, 1.0, 2.0)
    energies = [quadratic_energy(fluid, march(fluid, state, 0.5 / n, n, stepper)) for n in (10, 20)]
    losses = [abs(energy / quadratic_energy(fluid, state) - 1) for energy in energies]
    assert losses[1] < 2e-7 and np.log2(losses[0] / losses[1]) > 4.7


@pytest.mark.mpi(1)
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("advection, viscosity, sound", [
    (3.0, 0.0, 0.0), (3.0, 1.0, 0.0),  # beyond the limit of advection, and stabilised by viscosity with ETDRK4
    (0.0, 2.9, 0.0), (1.0, 0.0, 2.5)])  # beyond RK4's viscous limit, and sound that leaks with ETDRK4
def test_a_wave_in_a_uniform_flow_grows_as_theory_says(comm, stepper, advection, viscosity, sound):
    theory = np.abs(amplification(stepper, [1j * sound - viscosity, -1j * sound - viscosity], [advection] * 2)).max()
    assert measured_growth(comm, stepper, advection, viscosity, sound) == pytest.approx(theory, rel=1e-4)
