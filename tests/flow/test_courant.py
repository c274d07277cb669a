import numpy as np
import pytest

from eddies.clock import Clock
from eddies.flow.courant import CourantLimit
from eddies.flow.initial_fields import taylor_green
from eddies.flow.navier_stokes import CompressibleFluid, advective_speed
from eddies.flow.stability import FlowDiverged, step_limits
from eddies.time_stepping import RungeKutta4
from tests.validation.flows import make_grid


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
