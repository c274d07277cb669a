"""Particles where they can hardly be: coincident, clustered, alone, on a lattice."""

import pytest
import torch
from extreme_cases import (
    ARRANGEMENTS, CLOSURES, SIDE, TOTAL, acceleration, advance, every_closure, every_integrator, flow_velocity,
    lattice, network_model, random_points, set_up,
)
from mpi4py import MPI

from eddies.parallel.reduction import any_rank, global_max
from tests.particles.configurations import LENGTH, by_id

SEPARATIONS = [0.0, 1e-300, 1e-16, 1e-8]  # of nearly coincident particles, in mean spacings


def pairs_at(separation, total):
    """Random points, the first of which lie at the origin, and a twin of each at a separation in mean spacings."""
    single = random_points(total // 2)
    single[0] = 0.0
    shift = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64) * separation * LENGTH / round(total ** (1 / 3))
    return torch.cat([single, single + shift])


def finite(comm, particles):
    columns = [column for name, column in particles.columns().items() if name != "id"]
    return not any_rank(comm, not all(bool(torch.isfinite(column).all()) for column in columns))


def nearly_coincident(comm, kind, separation, total=TOTAL):
    """Largest difference of accelerations from those of coincident particles over the largest of them, and whether
    two steps of velocity Verlet stay finite."""
    model, position = network_model(kind, total), pairs_at(separation, total)
    velocity = flow_velocity(pairs_at(0.0, total))
    together = acceleration(comm, model, pairs_at(0.0, total), velocity=velocity)
    apart = acceleration(comm, model, position, velocity=velocity)
    end = advance(*set_up(comm, model, position, velocity), "verlet", 0.01, 2)
    return float((apart - together).abs().max() / together.abs().max()), finite(comm, end)


def arrangement(comm, kind, name, total=TOTAL, count=2):
    """Largest difference of the accelerations from those on one rank, over the largest of them or the typical one; and
    whether steps stay finite."""
    model, position = network_model(kind, total), ARRANGEMENTS[name](total)
    alone, here = (acceleration(group, model, position) for group in (MPI.COMM_SELF, comm))
    end = advance(*set_up(comm, model, position), "rk2", 0.01, count)
    largest = alone.abs().max().clamp_min(model.flow.scales.acceleration)
    return float((here - alone).abs().max() / largest), finite(comm, end)


def few_particles(comm, kind, integrator, total):
    """Largest distance from straight lines of particles too far apart to see each other, after three steps."""
    position = torch.full((total, 3), 1.0, dtype=torch.float64)
    position[:, 2] = (torch.arange(total) + 0.25) * LENGTH / total
    model = network_model(kind, TOTAL)
    dynamics, particles = set_up(comm, model, position)
    end = advance(dynamics, particles, integrator, 0.02, 3)
    found = by_id(comm, end, end.position, total)
    straight = position + 0.06 * flow_velocity(position)
    return float(dynamics.box.displacement(found, straight).abs().max())


def pushed_by_the_grid(kind):
    """Whether the model has a force from its grid."""
    return "resolved" in network_model(kind, TOTAL).reads


def lattice_at_rest(comm, kind, dtype=torch.float64, side=SIDE, count=5):
    """Largest speed after `count` steps, over what a step of the typical acceleration gives."""
    model, position = network_model(kind, side**3), lattice(side)
    dynamics, particles = set_up(comm, model, position, torch.zeros_like(position), dtype=dtype)
    end = advance(dynamics, particles, "verlet", 0.02, count)
    speed = global_max(comm, float(end.velocity.abs().max()) if len(end) else 0.0)
    return float(speed) / (0.02 * model.flow.scales.acceleration)


@pytest.mark.mpi(1)
@every_closure
def test_nearly_coincident_particles_move_as_coincident_ones(comm, kind):
    for separation in SEPARATIONS:
        difference, sound = nearly_coincident(comm, kind, separation)
        # Accelerations vary over the cutoff, here two spacings, by a few times themselves; where the few neighbours
        # are nearly in a plane, by a hundred times.
        assert sound and difference <= 300 * separation + 1e-12


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", ARRANGEMENTS)
@pytest.mark.parametrize("kind", ["resolved + pairs", "pressure", "own density", "local"])
def test_any_arrangement_has_finite_rates_that_are_the_same_on_all_ranks(comm, kind, name):
    difference, sound = arrangement(comm, kind, name)
    assert sound and difference < 1e-9


@pytest.mark.mpi(2)
@pytest.mark.parametrize("total", [1, 2])
@every_integrator
def test_few_particles_move_straight_on(comm, integrator, total):
    """One a rank, and none on a rank. But two push each other by the pressure on a grid, from any distance."""
    for kind in CLOSURES:
        if total == 1 or not pushed_by_the_grid(kind):
            assert few_particles(comm, kind, integrator, total) < 1e-12


@pytest.mark.mpi(1)
@every_closure
def test_a_lattice_at_rest_stays_at_rest(comm, kind):
    # The pressures of WCSPH are c^2, a hundred times the accelerations, and cancel.
    assert lattice_at_rest(comm, kind) < (1e-11 if kind == "wcsph" else 1e-13)
    assert lattice_at_rest(comm, kind, torch.float32) < (1e-3 if kind == "wcsph" else 1e-5)
