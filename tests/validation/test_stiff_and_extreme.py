"""The solver where it is stiff or extreme, and the error of a step that is too long."""

import numpy as np
import pytest
from flows import make_grid, march, turbulence

from eddies.clock import Clock
from eddies.errors import UserError
from eddies.flow import initial_fields
from eddies.flow.stability import GROWTH, CourantLimit, FlowDiverged, quadratic_energy
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.parallel.reduction import global_sum
from eddies.scene.scene import load_scene
from eddies.time_stepping import ETDRK4
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


@pytest.mark.mpi(2)
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
@pytest.mark.parametrize("index, cutoff", [((0, 1, -1), 1), ((2, 2, 2), None), ((0, 0, 2), None)])
def test_a_flow_of_one_wavevector_decays_exactly(comm, index, cutoff):
    grid, nu, k = make_grid(comm, 8, cutoff=cutoff), 0.3, np.array(index)
    direction = np.cross(k, [1, 2, 5])
    phase = sum(number * x for number, x in zip(k, grid.coordinates()))
    start = grid.forward(np.cos(phase) * direction[:, None, None, None] / np.linalg.norm(direction))
    end = march(IncompressibleFluid(grid, nu), start, 0.1, 10)
    assert norm(comm, end - start * np.exp(-nu * (k @ k))) < 1e-14 * norm(comm, start)


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


@pytest.mark.mpi(2)
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
