"""The solver against flows whose evolution is known."""

import numpy as np
import pytest
from flows import make_grid, march, with_density

from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.statistics import incompressible_budget
from eddies.flow.stability import quadratic_energy
from eddies.parallel.reduction import global_max
from eddies.time_stepping import STEPPERS, phi


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


def amplification(stepper, z, w):
    """The factor by which one step multiplies u of u' = L u + i a u, with z = step L and w = step a."""
    z, w = np.array([z], complex), 1j * w
    if stepper == "rk4":
        return abs(sum((z + w) ** n / factorial for n, factorial in enumerate((1, 1, 2, 6, 24)))[0])
    full, half, q = np.exp(z), np.exp(z / 2), phi(1, z / 2) / 2
    p1, p2, p3 = (phi(order, z) for order in (1, 2, 3))
    a = half + q * w
    b = half + q * w * a
    c = half * a + q * w * (2 * b - 1)
    return abs((full + w * ((p1 - 3 * p2 + 4 * p3) + (2 * p2 - 4 * p3) * (a + b) + (4 * p3 - p2) * c))[0])


@pytest.mark.mpi(1)
@pytest.mark.parametrize("stepper", STEPPERS)
@pytest.mark.parametrize("advection, viscosity, sound", [
    (2.7, 0.0, 0.0), (3.0, 0.0, 0.0), (3.0, 1.0, 0.0),  # inside, beyond, and stabilised by viscosity with ETDRK4
    (0.0, 2.6, 0.0), (0.0, 2.9, 0.0), (1.0, 0.0, 2.5)])  # RK4's viscous limit, and sound that leaks with ETDRK4
def test_a_wave_in_a_uniform_flow_grows_as_theory_says(comm, stepper, advection, viscosity, sound):
    """The highest wave is an eigenvector of advection, sound and viscosity, so a step multiplies it by the
    amplification factor of the scheme."""
    grid, count = make_grid(comm, 8), 20
    k = grid.cutoff
    state = np.zeros((4 if sound else 3, *grid.spectral_shape), complex)
    state[0, 0, 0, 0] = advection / k
    state[0 if sound else 1, 0, 0, k] = 1e-6  # its square, its effect on itself, is negligible
    fluid = CompressibleFluid(grid, 0.0, sound / k) if sound else IncompressibleFluid(grid, viscosity / k**2)
    end = march(fluid, state, 1.0, count, stepper)
    if sound:  # waves to the right and to the left do not mix
        sizes = [abs(end[0, 0, 0, k] + sign * sound / k * end[3, 0, 0, k]) for sign in (1, -1)]
    else:
        sizes = [abs(end[1, 0, 0, k])]
    theory = max(amplification(stepper, sign * 1j * sound - viscosity, advection) for sign in (1, -1))
    assert (max(sizes) / 1e-6) ** (1 / count) == pytest.approx(theory, rel=1e-4)
