import numpy as np
import pytest
from scipy.integrate import solve_ivp

from eddies.flow import initial_fields
from eddies.flow.tracers import FilteredField, TracerParticles, lattice_positions, random_positions, release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder, census
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.mode_operators import gaussian_transfer
from tests.validation.flows import make_grid

LENGTH = 2 * np.pi


def followed(comm, width, amplitude=1.0):
    """Tracers of a filtered ABC flow, and the flow."""
    grid = make_grid(comm, 16)
    state = initial_fields.abc(grid, amplitude, 1)
    released = release(grid.decomposition, 3, 4**3, "random")
    tracers = TracerParticles(FilteredField(grid, width, "quintic"), released, state)
    return tracers, state


@pytest.mark.mpi(3)
def test_a_particle_may_move_through_as_many_planes_as_the_margin(comm):
    """A step with a Courant number above 1 does this. The field is that of the rank that owns these places."""
    grid = make_grid(comm, 18)
    slab = grid.decomposition
    modes = initial_fields.random_velocity(grid, 7, 1.0, 1.5)
    outside = (slab.start + slab.count + np.array([-0.5, 0.5, 1.9])) * slab.spacing
    points = np.stack([np.full(3, 0.3), np.full(3, 1.7), outside % LENGTH], axis=1)
    field = FilteredField(grid, 0.4, "cubic", margin=2)
    found = comm.allgather(field.spline.at(field.velocity_coefficients(modes), points))[comm.rank - 1]
    theirs = points.copy()
    theirs[:, 2] = (slab.start + np.array([-0.5, 0.5, 1.9])) * slab.spacing % LENGTH
    assert np.allclose(found, field.spline.at(field.velocity_coefficients(modes), theirs), rtol=0, atol=1e-13)
    with pytest.raises(HaloError, match="farther out of its slab"):
        FilteredField(grid, 0.4, "cubic").spline.at(field.velocity_coefficients(modes), points)


@pytest.mark.mpi(1, 3)
def test_release_depends_on_id_and_seed_only(comm):
    """And each particle of a lattice starts within a quarter of a cell from the centre of its own."""
    slab = SlabDecomposition(comm, LENGTH, 9)
    particles = release(slab, 3, 6**3, "random")
    assert np.array_equal(particles["position"], random_positions(3, 216, 0, 216, LENGTH)[particles["id"]])
    assert np.all(slab.owner_of(particles["position"][:, 2]) == comm.rank)
    lattice = release(slab, 3, 5**3, "lattice")
    positions = lattice_positions(3, 5, 0, 125, LENGTH)
    assert np.array_equal(lattice["position"], positions[lattice["id"]])
    cells = positions / (LENGTH / 5)
    assert len(np.unique(np.floor(cells), axis=0)) == 125
    assert 0.2 < np.abs(cells % 1 - 0.5).max() <= 0.25


def exact_path(position, attenuation, time):
    """The same trajectories with the exact velocity."""
    def velocity(_, flat):
        x, y, z = flat.reshape(3, -1)
        return attenuation * np.concatenate([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)])

    return solve_ivp(velocity, (0, time), position.T.ravel(), rtol=1e-9, atol=1e-9).y[:, -1].reshape(3, -1).T


@pytest.mark.mpi(1, 3)
def test_tracers_follow_the_filtered_abc_flow_at_second_order_across_slabs_and_faces(comm):
    exact = exact_path(random_positions(3, 64, 0, 64, LENGTH), gaussian_transfer(1.0, 1.0), 2.0)
    assert np.abs(exact).max() > LENGTH  # some leave through the periodic faces
    errors = []
    for count in (20, 40):
        tracers, state = followed(comm, width=1.0)
        for _ in range(count):
            tracers.advance(state, 2.0 / count)
        order = IdOrder(comm, tracers.columns["id"], 64)
        distance = (order.apply(tracers.columns["position"]) - exact[order.start : order.stop] + np.pi) % LENGTH - np.pi
        errors.append(float(global_max(comm, np.abs(distance).max(initial=0))))
        assert census(comm, tracers.columns["id"])[:2] == (64, 64 * 63 // 2)
    assert np.log2(errors[0] / errors[1]) > 1.8 and errors[1] < 0.02


@pytest.mark.mpi(2)
def test_the_velocity_of_a_tracer_is_that_of_the_field_where_it_is(comm):
    """Also after a step: not that at the predicted position."""
    tracers, _ = followed(comm, width=1.0)
    end = initial_fields.abc(tracers.field.grid, 0.8, 1)
    tracers.advance(end, 0.2)
    field = tracers.field
    there = field.spline.at(field.velocity_coefficients(end), tracers.columns["position"])
    # Wrapped positions differ by rounding.
    assert np.allclose(tracers.columns["velocity"], there, rtol=0, atol=1e-13)


@pytest.mark.mpi(2)
def test_density_at_the_particles_is_the_filtered_exponential(comm):
    tracers, state = followed(comm, width=0.5, amplitude=0.0)
    s = initial_fields.sound_wave_density(tracers.field.grid, 1e-4, 1)
    x = tracers.columns["position"][:, 0]
    # The quadratic term of the exponential is 1e-8.
    expected = 1 + 1e-4 * gaussian_transfer(1.0, 0.5) * np.cos(x)
    assert np.allclose(tracers.density(np.concatenate([state, s[None]])), expected, atol=1e-8)
