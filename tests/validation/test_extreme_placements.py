"""Particles in extreme places: coincident, clustered, alone, on a lattice."""

import pytest
import torch
from extreme_cases import (
    ARRANGEMENTS, TOTAL, acceleration, advance, every_closure, flow_velocity, has_grid, network_model,
    random_points, set_up,
)
from mpi4py import MPI

from eddies.parallel.reduction import any_rank
from eddies.particles.integrators import INTEGRATORS
from tests.particles.configurations import LENGTH, by_id, lattice


def is_finite(comm, particles):
    columns = [column for name, column in particles.columns().items() if name != "id"]
    return not any_rank(comm, not all(bool(torch.isfinite(column).all()) for column in columns))


@pytest.mark.mpi(1)
@every_closure
def test_nearly_coincident_particles_move_as_coincident_ones(comm, kind):
    """Each of the first particles has a twin; one pair lies at the origin."""
    model, single = network_model(kind), random_points(TOTAL // 2)
    single[0] = 0.0
    velocity = flow_velocity(torch.cat([single, single]))
    together = acceleration(comm, model, torch.cat([single, single]), velocity=velocity)
    for separation in (1e-300, 1e-8):  # in mean spacings
        shift = torch.tensor([separation * model.flow.scales.spacing, 0.0, 0.0], dtype=torch.float64)
        position = torch.cat([single, single + shift])
        apart = acceleration(comm, model, position, velocity=velocity)
        # Accelerations vary over the cutoff, here two spacings, by a few times themselves; where the few neighbours
        # are nearly in a plane, by a hundred times.
        assert (apart - together).abs().max() <= (300 * separation + 1e-12) * together.abs().max()
        assert is_finite(comm, advance(*set_up(comm, model, position, velocity), "verlet", 0.01, 2))


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name, kind", [
    ("in 1 % of the box", "resolved + pairs"), ("in 1 % of the box, across a corner", "own density"),
    ("empty octant", "local"), ("in a plane", "local"), ("on a line", "resolved + pairs"),
    ("all at one point", "resolved + pairs"), ("all at one point", "own density"), ("all at one point", "local")])
def test_any_arrangement_has_finite_rates_that_are_the_same_on_all_ranks(comm, kind, name):
    model, position = network_model(kind), ARRANGEMENTS[name]
    alone, here = (acceleration(group, model, position) for group in (MPI.COMM_SELF, comm))
    largest = alone.abs().max().clamp_min(model.flow.scales.acceleration)
    assert (here - alone).abs().max() < 1e-9 * largest
    assert is_finite(comm, advance(*set_up(comm, model, position), "rk2", 0.01, 1))


@pytest.mark.mpi(2)
@every_closure
def test_few_particles_move_straight_on(comm, kind):
    """One particle on each rank; with a pressure, by which two push each other from any distance, one in all."""
    total = 1 if has_grid(kind) else 2
    position = torch.full((total, 3), 1.0, dtype=torch.float64)
    position[:, 2] = (torch.arange(total) + 0.25) * LENGTH / total
    dynamics, particles = set_up(comm, network_model(kind), position)
    for integrator in INTEGRATORS:
        end = advance(dynamics, particles, integrator, 0.02, 2)
        straight = position + 0.04 * flow_velocity(position)
        off = dynamics.box.displacement(by_id(comm, end, end.position, total), straight)
        assert off.abs().max() < 1e-12, integrator


@pytest.mark.mpi(1)
@every_closure
def test_a_lattice_at_rest_stays_at_rest(comm, kind):
    position = lattice(5)
    for dtype, most in ((torch.float64, 1e-13), (torch.float32, 1e-5)):
        model = network_model(kind)
        dynamics, particles = set_up(comm, model, position, torch.zeros_like(position), dtype=dtype)
        end = advance(dynamics, particles, "verlet", 0.02, 3)
        # The pressures of WCSPH are c^2, a hundred times the accelerations, and cancel.
        most *= 100 if kind == "wcsph" else 1
        assert end.velocity.abs().max() < most * 0.02 * model.flow.scales.acceleration
