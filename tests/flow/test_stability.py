import numpy as np
import pytest

from eddies.clock import Clock
from eddies.flow.forcing import LinearForcing
from eddies.flow.history import FlowHistory
from eddies.flow.initial_fields import taylor_green
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid, advective_speed
from eddies.flow.stability import (
    GROWTH, IMAGINARY_REACH, REAL_REACH, CourantLimit, FlowDiverged, StabilityWatch, advice, quadratic_energy,
    step_limits,
)
from eddies.time_stepping import ETDRK4, RungeKutta4
from tests.validation.flows import amplification, make_grid, turbulence


def watched(fluid):
    return StabilityWatch(fluid, ETDRK4(fluid), FlowHistory(fluid))


def test_rk4_is_stable_on_the_axes_up_to_its_reach():
    for axis, reach in ((1j, IMAGINARY_REACH), (-1, REAL_REACH)):
        inside = np.linspace(0, reach * (1 - 1e-9), 100)
        assert np.abs(amplification("rk4", axis * inside, 0 * inside)).max() <= 1 + 1e-12
        assert np.abs(amplification("rk4", axis * reach * (1 + 1e-6), 0)) > 1


@pytest.mark.mpi(1)
@pytest.mark.parametrize("nu, c, expected", [(0.3, 1e-3, "viscosity"), (0.0, 7.0, "sound")])
def test_numbers_of_a_step_are_those_of_the_linear_terms(comm, nu, c, expected):
    # Power iteration on the linear terms finds their eigenvalue of the largest modulus.
    fluid, state = turbulence(comm, 12, nu, c)
    state[3] = state[0]
    for _ in range(60):
        state = fluid.linear(state) / np.abs(state).max()
    rate = np.sqrt(np.linalg.norm(fluid.linear(fluid.linear(state))) / np.linalg.norm(state))
    limits = {limit.name: limit.number for limit in step_limits(fluid, RungeKutta4(fluid), 0.01, 0.0)}
    assert limits[expected] == pytest.approx(0.01 * rate, rel=0.02)


@pytest.mark.mpi(1)
def test_each_stepper_has_the_limits_of_what_it_does_not_take_exactly(comm):
    fluid, _ = turbulence(comm, 12)
    incompressible = IncompressibleFluid(fluid.grid, 0.05)
    names = [[limit.name for limit in step_limits(flow, stepper(flow), 0.1, 2.0)]
             for flow in (fluid, incompressible) for stepper in (ETDRK4, RungeKutta4)]
    assert names == [["advection"], ["advection", "sound", "viscosity"], ["advection"], ["advection", "viscosity"]]
    # k_max = 3
    assert [limit.number for limit in step_limits(incompressible, RungeKutta4(fluid), 0.1, 2.0)] == pytest.approx(
        [0.1 * 3 * 2.0, 0.1 * 3 * 0.05 * 9])


@pytest.mark.mpi(1)
def test_advice_names_the_broken_limit_or_the_grid(comm):
    fluid, _ = turbulence(comm, 12)
    text = advice(fluid, step_limits(fluid, RungeKutta4(fluid), 0.1, 2.0), 1.0)
    assert "sound" in text and "4.76" in text and "2.83" in text and "courant" in text
    assert "advection" not in text and "cells" not in text
    text = advice(fluid, step_limits(fluid, ETDRK4(fluid), 0.1, 2.0), 0.31)
    assert "advection" in text and "0.31" in text and "cells" in text and "sound" in text
    inviscid, _ = turbulence(comm, 12, nu=0.0)
    assert "no viscosity" in advice(inviscid, [], 0.0)
    assert "sound_speed" in advice(fluid, [], 1.0, mach=1.5)


@pytest.mark.mpi(3)
def test_quadratic_energy_is_that_of_the_fields(comm):
    fluid, state = turbulence(comm, 12)
    fields = fluid.grid.backward(state)
    kinetic, sound = (0.5 * float(fluid.grid.mean(part**2).sum()) for part in (fields[:3], fields[3:]))
    assert quadratic_energy(fluid, state) == pytest.approx(kinetic + 64 * sound, rel=1e-13)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("number", [np.nan, 1e200])
def test_all_ranks_see_one_mode_that_is_not_finite_at_its_step(comm, number):
    fluid, state = turbulence(comm, 12)
    watch, clock, harmed = watched(fluid), Clock(), state.copy()
    clock.tick(0.01)
    watch(state, state, 0.01, clock)
    if fluid.grid.index[1][0, -1, 0] == -1:  # only the rank that holds the last ky
        harmed[1, 2, -1, 1] = number
    clock.tick(0.01)
    with pytest.raises(FlowDiverged, match="step 2, time 0.02: .* finite"):
        watch(state, harmed, 0.01, clock)


@pytest.mark.mpi(2)
def test_energy_without_a_source_is_seen_and_injected_energy_is_not(comm):
    fluid, state = turbulence(comm, 12)
    grown = np.sqrt(GROWTH) * state
    with pytest.raises(FlowDiverged, match="the flow had only"):
        watched(fluid)(state, 1.001 * grown, 0.01, Clock())
    watched(fluid)(state, 0.999 * grown, 0.01, Clock())
    # Lost energy cannot come back, also not after a restart.
    watch, restored = watched(fluid), watched(fluid)
    watch(state, 0.1 * state, 0.01, Clock())
    restored.load_state_dict(watch.state_dict())
    for each in (watch, restored):
        with pytest.raises(FlowDiverged):
            each(0.5 * state, 0.99 * state, 0.01, Clock())
    watched(fluid)(0.5 * state, 0.99 * state, 0.01, Clock())
    fluid.forcing = LinearForcing(fluid.grid, 0.5, 2.0)
    watched(fluid)(state, 1.001 * grown, 0.1, Clock())


@pytest.mark.mpi(1)
def test_a_start_that_is_not_finite_is_refused_before_the_first_step(comm):
    fluid, state = turbulence(comm, 12)
    state[0, 0, 0, 1] = np.nan
    with pytest.raises(FlowDiverged, match="step 0, .*amplitude or path"):
        FlowHistory(fluid).sample(state, Clock())


@pytest.mark.mpi(2)
def test_a_restored_limit_keeps_its_step_until_the_next_measurement(comm):
    grid = make_grid(comm, 8)
    slow, fast, clock = taylor_green(grid, 1.0), taylor_green(grid, 4.0), Clock()
    limit, restored, fresh = (CourantLimit(grid, 0.5, 1.0) for _ in range(3))
    step = limit(slow, clock)
    clock.steps = 3  # the next measurement is at step 8, although the flow is faster now
    restored.load_state_dict(limit.state_dict())
    assert restored(fast, clock) == limit(fast, clock) == step > fresh(fast, clock)
    clock.steps = 8
    assert restored(fast, clock) == fresh(fast, clock)


@pytest.mark.mpi(1)
def test_the_last_step_ends_at_the_end(comm):
    grid = make_grid(comm, 8)
    velocity, limit = taylor_green(grid, 1.0), CourantLimit(grid, 0.5, 1.0)
    step = limit(velocity, Clock())
    clock = Clock(2.5 * step)
    while clock.running:
        clock.tick(limit(velocity, clock))
    assert clock.time == pytest.approx(2.5 * step, rel=1e-15) and clock.steps == 3


@pytest.mark.mpi(1)
def test_a_courant_number_of_1_3_keeps_the_explicit_stepper_just_stable(comm):
    # k_max dx is at most 2 pi / 3, and 1.35 times that is 2.83.
    grid = make_grid(comm, 32)
    fluid, velocity = CompressibleFluid(grid, 0.0, 3.0), taylor_green(grid, 1.0)
    step = CourantLimit(grid, 1.3, 1.0, 3.0).bound(velocity, Clock())
    limits = step_limits(fluid, RungeKutta4(fluid), step, advective_speed(grid, velocity))
    assert not any(limit.exceeded for limit in limits) and limits[1].number > 2.5


@pytest.mark.mpi(1, 3)
def test_the_fastest_point_of_any_rank_limits_the_step_of_all(comm):
    grid = make_grid(comm, 8)
    spacing, (_, _, z) = grid.decomposition.spacing, grid.coordinates()
    velocity = np.zeros((3, *grid.physical_shape))
    velocity[0] = 1 + np.cos(z + spacing)  # 2 in the last plane of the last rank, at most 1.71 on the others
    bound = CourantLimit(grid, 0.5, 1.0).bound(grid.forward(velocity), Clock())
    assert bound == pytest.approx(0.5 * spacing / 2, rel=1e-12)


@pytest.mark.mpi(2)
def test_all_ranks_report_a_velocity_that_is_not_finite(comm):
    grid = make_grid(comm, 8)
    velocity = taylor_green(grid, 1.0)
    if comm.rank == 0:
        velocity[0, 0, 0, 1] = float("nan")
    with pytest.raises(FlowDiverged, match="step 0, .* not finite"):
        CourantLimit(grid, 0.5, 1.0).bound(velocity, Clock())
