"""The solver where it is stiff or extreme, and what it says of a step that is too long."""

import numpy as np
import pytest
from flows import make_grid, march, turbulence

from eddies.clock import Clock
from eddies.errors import UserError
from eddies.flow import initial_fields
from eddies.flow.courant import CourantLimit
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.flow.stability import GROWTH, FlowDiverged, quadratic_energy
from eddies.parallel.reduction import global_max, global_sum
from eddies.scene.scene import load_scene
from eddies.time_stepping import ETDRK4, STEPPERS
from eddies.workflows import dns
from eddies.workflows.ground_truth.flow_run import FlowRun
from eddies.workflows.ground_truth.scene_flow import build_fluid, initial_state

VISCOSITIES = [1e-4, 1e-3, 1e-2, 0.1, 1.0, 10.0, 100.0]
TIME_STEPS = [1e-3, 0.1, 10.0]
ODD_GRIDS = [8, 9, 15, 18, 21]
RANDOM = ["initial.kind=random", "initial.peak_wavenumber=2"]
# What diverges, by the limit that is broken: scene, overrides.
TOO_LONG = {
    "sound": ("sound-wave", ["time.stepper=rk4", "flow.sound_speed=30", "time.step=0.05"]),
    "viscosity": ("shear-wave", ["time.stepper=rk4", "flow.viscosity=15", "initial.wavenumber=2", "time.step=0.05"]),
    "advection": ("taylor-green", [*RANDOM, "time.step=1.3"]),
    "advection, rk4": ("taylor-green", [*RANDOM, "time.stepper=rk4", "time.step=1.3"]),
}


def norm(comm, modes):
    return float(np.sqrt(global_sum(comm, np.sum(np.abs(modes) ** 2, dtype=float))))


def run_at_mach_number(comm, mach):
    """The flow that a watched run of 0.25 time units, with steps after the flow, ends with."""
    fluid, state = turbulence(comm, 24, 0.05, np.sqrt(3) / mach)
    run = FlowRun(fluid, state, ETDRK4(fluid), CourantLimit(fluid.grid, 0.8, 0.05), FlowHistory(fluid, every=1),
                  lambda run, segments=None: None, Clock(end=0.25))
    run.history.sample(state, run.clock)
    run.advance([run.history])
    return run


def shear_wave_error(comm, fluid_kind, nu, step):
    """Largest error of a shear wave of amplitude 1 after five steps."""
    grid, k, count = make_grid(comm, 8), 2, 5
    start = initial_fields.shear_wave(grid, 1.0, k)
    fluid = IncompressibleFluid(grid, nu)
    if fluid_kind == "compressible":
        fluid, start = CompressibleFluid(grid, nu, 20.0), np.concatenate([start, np.zeros_like(start[:1])])
    end = march(fluid, start, step, count)
    return float(global_max(comm, np.abs(end - start * np.exp(-nu * k**2 * step * count)).max(initial=0.0)))


def inviscid_energy_error(comm, stepper, step):
    """Relative change of the energy in a time of 0.5 without viscosity."""
    grid = make_grid(comm, 15)
    fluid, state = IncompressibleFluid(grid, 0.0), initial_fields.random_velocity(grid, 3, 1.0, 2.0)
    end = march(fluid, state, step, round(0.5 / step), stepper)
    return abs(quadratic_energy(fluid, end) / quadratic_energy(fluid, state) - 1)


def one_wavevector_error(comm, index, cutoff=None):
    """Relative error of a flow of one wavevector, which only decays, after 10 steps of 0.1."""
    grid, nu = make_grid(comm, 8, cutoff=cutoff), 0.3
    k = np.array(index)
    direction = np.cross(k, [1, 2, 5])
    phase = sum(number * x for number, x in zip(k, grid.coordinates()))
    start = grid.forward(np.cos(phase) * direction[:, None, None, None] / np.linalg.norm(direction))
    end = march(IncompressibleFluid(grid, nu), start, 0.1, 10)
    return norm(comm, end - start * np.exp(-nu * (k @ k))) / norm(comm, start)


def single_precision_error(comm, count):
    """Relative difference of the velocity in float32 from that in float64 after some steps of forced turbulence."""
    ends = []
    for precision in ("float32", "float64"):
        fluid, state = turbulence(comm, 16, 0.02, 10.0, precision, rate=0.5)
        ends.append(march(fluid, state, 0.02, count)[:3])
    return norm(comm, ends[0] - ends[1]) / norm(comm, ends[1])


def error_of_ranks(comm, cells):
    """Largest difference of the modes from those on one rank, after five steps of forced turbulence."""
    ends = []
    for group in (comm, comm.Split(comm.rank)):
        fluid, state = turbulence(group, cells, 0.05, 8.0, rate=0.5)
        ends.append(march(fluid, state, 0.02, 5))
    first = make_grid(comm, cells).column_starts[comm.rank]
    own = ends[1][:, :, first : first + ends[0].shape[2]]
    return float(global_max(comm, np.abs(ends[0] - own).max(initial=0.0)))


def diverging_scene(limit):
    name, overrides = TOO_LONG[limit]
    return load_scene(name, ["flow.cells=8", "time.duration=4", *overrides])


@pytest.mark.mpi(2)
def test_mach_numbers_0_01_and_0_5_take_the_same_steps_and_keep_the_energy_budget(comm):
    runs = {mach: run_at_mach_number(comm, mach) for mach in (0.01, 0.5)}
    for mach, run in runs.items():
        assert run.history.rows[0]["mach_turbulent"] == pytest.approx(mach, rel=1e-6)
        # Ten trapezoids of the dissipation, and at k_max eta = 0.8 truncation of an energy that is not quadratic.
        assert run.history.budget_error < 1e-3
    assert abs(runs[0.01].clock.steps - runs[0.5].clock.steps) <= 1


@pytest.mark.mpi(1)
@pytest.mark.parametrize("fluid", ["incompressible", "compressible"])
def test_a_shear_wave_is_exact_for_any_viscosity_and_step(comm, fluid):
    errors = [shear_wave_error(comm, fluid, nu, step) for nu in VISCOSITIES for step in TIME_STEPS]
    assert max(errors) < 1e-15


@pytest.mark.mpi(1)
@pytest.mark.parametrize("stepper", list(STEPPERS))
def test_without_viscosity_the_energy_stays(comm, stepper):
    # A step multiplies a wave by |R(i w)| = 1 - w^6/144: energy is lost at the fifth order of the step.
    coarse, fine = (inviscid_energy_error(comm, stepper, step) for step in (0.05, 0.025))
    assert fine < 2e-7 and np.log2(coarse / fine) > 4.7


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("index, cutoff", [((1, 0, 0), 1), ((0, 1, -1), 1), ((2, 2, 2), None), ((0, 0, 2), None)])
def test_a_flow_of_one_wavevector_decays_exactly(comm, index, cutoff):
    assert one_wavevector_error(comm, index, cutoff) < 1e-14


@pytest.mark.mpi(3)
@pytest.mark.parametrize("cells", ODD_GRIDS)
def test_small_and_odd_grids_are_the_same_on_one_rank_and_three(comm, cells):
    assert error_of_ranks(comm, cells) < 1e-13


@pytest.mark.mpi(1)
def test_single_precision_follows_double_precision(comm):
    # About one unit of round-off, 6e-8, for the start and half of one for every step.
    assert 1e-8 < single_precision_error(comm, 20) < 2e-6


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("limit", list(TOO_LONG))
def test_a_run_that_diverges_says_so_at_the_step_and_names_the_limit(comm, tmp_path, limit):
    scene = diverging_scene(limit)
    with pytest.raises(FlowDiverged, match=f"Broken: {limit.split(',')[0]}, .* stable up to 2.[78]") as caught:
        dns.run(scene, comm, tmp_path)
    assert isinstance(caught.value, UserError)
    fluid = build_fluid(scene, comm)
    states = [initial_state(scene, fluid)]
    energies = [quadratic_energy(fluid, states[0])]
    with np.errstate(all="ignore"):
        while energies[-1] <= GROWTH * min(energies):
            states.append(march(fluid, states[-1], scene.time.step, 1, scene.time.stepper))
            energies.append(quadratic_energy(fluid, states[-1]))
    assert f"unstable at step {len(energies) - 1}, " in str(caught.value)
