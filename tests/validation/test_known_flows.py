"""The solver against flows whose evolution is known, where it is stiff or extreme, and with a step that is too long."""

import numpy as np
import pytest
from flows import amplification, make_grid, march, measured_growth, turbulence, with_density

from eddies.clock import Clock
from eddies.errors import UserError
from eddies.flow import initial_fields
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.stability import GROWTH, CourantLimit, FlowDiverged, quadratic_energy
from eddies.flow.statistics import incompressible_budget
from eddies.parallel.reduction import global_sum
from eddies.scene.scene import load_scene
from eddies.time_stepping import ETDRK4, STEPPERS
from eddies.workflows import dns
from eddies.workflows.ground_truth.flow_run import FlowRun
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state

RANDOM = ["initial.kind=random", "initial.peak_wavenumber=2"]
# Flows that diverge, by the broken limit: scene, overrides.
TOO_LONG = {
    "sound": ("sound-wave", ["time.stepper=rk4", "flow.sound_speed=30", "time.step=0.05"]),
    "viscosity": ("shear-wave", ["time.stepper=rk4", "flow.viscosity=15", "initial.wavenumber=2", "time.step=0.05"]),
    "advection": ("taylor-green", [*RANDOM, "time.step=1.3"]),
    "advection, rk4": ("taylor-green", [*RANDOM, "time.stepper=rk4", "time.step=1.3"]),
}


def norm(comm, modes):
    return float(np.sqrt(global_sum(comm, np.sum(np.abs(modes) ** 2, dtype=float))))


@pytest.mark.mpi(1)
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


@pytest.mark.mpi(1)
def test_mach_numbers_0_01_and_0_5_take_the_same_steps_and_keep_the_energy_budget(comm):
    steps = []
    for mach in (0.01, 0.5):
        fluid, state = turbulence(comm, 24, c=np.sqrt(3) / mach)
        run = FlowRun(fluid, state, ETDRK4(fluid), CourantLimit(fluid.grid, 0.8, 0.05), FlowHistory(fluid, every=1),
                      lambda run, segments=None: None, Clock(0.25))
        run.history.sample(state, run.clock)
        run.advance([run.history])
        assert run.history.rows[0]["mach_turbulent"] == pytest.approx(mach, rel=1e-6)
        # Ten trapezoids of the dissipation, and at k_max eta = 0.8 truncation of an energy that is not quadratic.
        assert run.history.budget_error < 1e-3
        steps.append(run.clock.steps)
    assert abs(steps[0] - steps[1]) <= 1


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", ["incompressible", "compressible"])
def test_a_shear_wave_is_exact_for_any_viscosity_and_step(comm, kind):
    grid, k, count = make_grid(comm, 8), 2, 5
    start = initial_fields.shear_wave(grid, 1.0, k)
    if kind == "compressible":
        start = np.concatenate([start, np.zeros_like(start[:1])])
    for nu in (0.0, 1e-4, 0.1, 100.0):
        fluid = IncompressibleFluid(grid, nu) if kind == "incompressible" else CompressibleFluid(grid, nu, 20.0)
        for step in (1e-3, 0.1, 10.0):
            error = march(fluid, start, step, count) - start * np.exp(-nu * k**2 * step * count)
            assert np.abs(error).max() < 1e-15, (nu, step)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("index, cells, cutoff", [((0, 1, -1), 8, 1), ((2, 2, 2), 8, None), ((0, 0, 2), 8, None),
                                                  ("abc", 16, None)])
def test_a_flow_of_one_wavenumber_decays_exactly(comm, index, cells, cutoff):
    """Waves of one wavevector, and the ABC flow, in which nonlinear terms are a gradient."""
    grid, nu = make_grid(comm, cells, cutoff=cutoff), 0.3
    if index == "abc":
        start, squared = initial_fields.abc(grid, 1.0, 2), 4
    else:
        k = np.array(index)
        direction, squared = np.cross(k, [1, 2, 5]), k @ k
        phase = sum(number * x for number, x in zip(k, grid.coordinates()))
        start = grid.forward(np.cos(phase) * direction[:, None, None, None] / np.linalg.norm(direction))
    end = march(IncompressibleFluid(grid, nu), start, 0.1, 10)
    assert norm(comm, end - start * np.exp(-nu * squared)) < 1e-14 * norm(comm, start)


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("cells", [4, 8, 9, 21])
def test_a_flow_is_the_same_on_any_number_of_ranks(comm, cells):
    """Also with uneven slabs, and with hardly more planes than ranks."""
    ends = []
    for group in (comm, comm.Split(comm.rank)):
        fluid, state = turbulence(group, cells, rate=0.5)
        ends.append(march(fluid, state, 0.02, 5))
    own = slice(*make_grid(comm, cells).column_starts[comm.rank :][:2])
    assert np.abs(ends[0] - ends[1][:, :, own]).max(initial=0.0) < 1e-13


@pytest.mark.mpi(1)
def test_single_precision_follows_double_precision(comm):
    ends = []
    for precision in ("float32", "float64"):
        fluid, state = turbulence(comm, 16, 0.02, 10.0, precision, rate=0.5)
        ends.append(march(fluid, state, 0.02, 20)[:3])
    # About one unit of round-off, 6e-8, for the start and half of one for every step.
    assert 1e-8 < norm(comm, ends[0] - ends[1]) / norm(comm, ends[1]) < 2e-6


@pytest.mark.mpi(1)
@pytest.mark.parametrize("limit", list(TOO_LONG))
def test_a_run_that_diverges_says_so_at_the_step_and_names_the_limit(comm, tmp_path, limit):
    name, overrides = TOO_LONG[limit]
    scene = load_scene(name, ["flow.cells=8", "time.duration=4", *overrides])
    with pytest.raises(FlowDiverged, match=f"Exceeded limits: {limit.split(',')[0]}, .* stable up to 2.[78]") as caught:
        dns.run(scene, comm, tmp_path)
    assert isinstance(caught.value, UserError)
    fluid = build_fluid(scene.flow, scene.forcing, comm)
    states = [initial_state(scene.initial, scene.seed, fluid)]
    energies = [quadratic_energy(fluid, states[0])]
    with np.errstate(all="ignore"):
        while energies[-1] <= GROWTH * min(energies):
            states.append(march(fluid, states[-1], scene.time.step, 1, scene.time.stepper))
            energies.append(quadratic_energy(fluid, states[-1]))
    assert f"at step {len(energies) - 1}, " in str(caught.value)
