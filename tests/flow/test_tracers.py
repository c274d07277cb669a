import numpy as np
import pytest

from eddies.flow import initial_fields
from eddies.flow.tracers import FilteredField, TracerParticles, lattice_positions, random_positions, release
from eddies.parallel.halo import HaloError
from eddies.parallel.migration import IdOrder, census
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.spectral.interpolation import SplineInterpolation
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.spectral.spectral_grid import SpectralGrid

LENGTH = 2 * np.pi


def make_grid(comm, cells):
    return SpectralGrid(SlabDecomposition(comm, LENGTH, cells))


def fourier_sum(grid, modes, points):
    """Direct evaluation of a field's Fourier series at points (n, 3); one rank."""
    kx, ky, kz = grid.index
    values = []
    for x, y, z in points:
        wave = np.exp(1j * (kx * x + ky * y + kz * z))
        values.append((grid.multiplicity * modes * wave).real.sum(axis=(1, 2, 3)))
    return np.array(values)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind, order", [("cubic", 4), ("quintic", 6)])
def test_interpolation_order_against_direct_fourier_sums(comm, kind, order):
    random = np.random.default_rng(6)
    points = random.uniform(0, LENGTH, (20, 3))
    errors = []
    for cells in (16, 32):
        grid = make_grid(comm, cells)
        modes = initial_fields.random_velocity(grid, 7, 1.0, 1.5)
        spline = SplineInterpolation(grid, kind)
        errors.append(np.abs(spline.at(spline.coefficients(modes), points) - fourier_sum(grid, modes, points)).max())
    assert np.log2(errors[0] / errors[1]) > order - 0.5


@pytest.mark.mpi(2, 3)
def test_a_particle_may_move_through_as_many_planes_as_the_margin(comm):
    """A step with a Courant number above 1 does this. There the field is that of the rank that owns these places."""
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


@pytest.mark.mpi(1, 2, 3)
@pytest.mark.parametrize("kind", ["cubic", "quintic"])
def test_interpolation_is_exact_at_grid_points_also_just_outside_the_slab(comm, kind):
    grid = make_grid(comm, 18)
    slab, dx = grid.decomposition, grid.decomposition.spacing
    velocity = initial_fields.random_velocity(grid, 7, 1.0, 2.0)
    spline = SplineInterpolation(grid, kind)
    planes = grid.backward(velocity)
    points = np.array([[3 * dx, -2 * dx, slab.lower], [0, 40 * dx, slab.lower]])
    found = spline.at(spline.coefficients(velocity), points)
    assert np.allclose(found, [planes[:, 0, 16, 3], planes[:, 0, 4, 0]], atol=1e-12)
    # The plane above the slab belongs to the neighbour, and a predicted position may lie there.
    outside = spline.at(spline.coefficients(velocity), np.array([[0.0, 0.0, slab.upper]]))
    whole = initial_fields.random_velocity(make_grid(_alone(), 18), 7, 1.0, 2.0)
    assert np.allclose(outside, make_grid(_alone(), 18).backward(whole)[:, slab.stop % 18, 0, 0], atol=1e-12)


def _alone():
    from mpi4py import MPI

    return MPI.COMM_SELF


@pytest.mark.mpi(1, 2, 3)
def test_release_depends_on_id_and_seed_only(comm):
    slab = SlabDecomposition(comm, LENGTH, 9)
    particles = release(slab, 3, 6, "random")
    assert np.array_equal(particles["position"], random_positions(3, 216, 0, 216, LENGTH)[particles["id"]])
    assert np.all(slab.owner_of(particles["position"][:, 2]) == comm.rank)


def test_lattice_keeps_each_particle_in_its_cell():
    positions = lattice_positions(3, 5, 0, 125, LENGTH)
    cells = np.floor(positions / (LENGTH / 5)).astype(int)
    assert len(np.unique(cells, axis=0)) == 125


class SteadyAbc:
    """Tracers in a steady, unfiltered ABC flow."""

    def __init__(self, comm, cells, width):
        self.grid = make_grid(comm, cells)
        self.state = initial_fields.abc(self.grid, 1.0, 1)
        self.attenuation = gaussian_transfer(1.0, width)
        field = FilteredField(self.grid, width, "quintic")
        self.tracers = TracerParticles(field, release(self.grid.decomposition, 3, 4, "random"), self.state)

    def run(self, time, count):
        for _ in range(count):
            self.tracers.advance(self.state, time / count)
        order = IdOrder(self.grid.decomposition.comm, self.tracers.columns["id"], 64)
        return order, order.apply(self.tracers.columns["position"])


def reference_path(position, attenuation, time, count=2000):
    """The same trajectories with the exact velocity and fourth-order Runge-Kutta."""
    def velocity(p):
        x, y, z = p.T
        return attenuation * np.stack([np.sin(z) + np.cos(y), np.sin(x) + np.cos(z), np.sin(y) + np.cos(x)], axis=1)

    h = time / count
    for _ in range(count):
        k1 = velocity(position)
        k2 = velocity(position + h / 2 * k1)
        k3 = velocity(position + h / 2 * k2)
        position = position + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(position + h * k3))
    return position


@pytest.mark.mpi(1, 2, 3)
def test_tracers_follow_the_filtered_abc_flow_at_second_order_across_slabs_and_faces(comm):
    exact = reference_path(random_positions(3, 64, 0, 64, LENGTH), gaussian_transfer(1.0, 1.0), 4.0)
    assert np.abs(exact).max() > LENGTH  # some leave through the periodic faces
    errors = []
    for count in (40, 80):
        flow = SteadyAbc(comm, 16, width=1.0)
        order, position = flow.run(4.0, count)
        distance = (position - exact[order.start : order.stop] + np.pi) % LENGTH - np.pi
        errors.append(float(global_max(comm, np.abs(distance).max(initial=0))))
        assert census(comm, flow.tracers.columns["id"])[:2] == (64, 64 * 63 // 2)
    assert np.log2(errors[0] / errors[1]) > 1.8 and errors[1] < 0.02


@pytest.mark.mpi(1, 2)
def test_the_velocity_of_a_tracer_is_that_of_the_field_where_it_is(comm):
    """After a step, too: not that at the predicted position."""
    grid = make_grid(comm, 16)
    start, end = (initial_fields.abc(grid, amplitude, 1) for amplitude in (1.0, 0.8))
    field = FilteredField(grid, 1.0, "quintic")
    tracers = TracerParticles(field, release(grid.decomposition, 3, 4, "random"), start)
    tracers.advance(end, 0.2)
    there = field.spline.at(field.velocity_coefficients(end), tracers.columns["position"])
    # Positions have been wrapped since, which changes them by rounding.
    assert np.allclose(tracers.columns["velocity"], there, rtol=0, atol=1e-13)


@pytest.mark.mpi(1, 2)
def test_density_at_the_particles_is_the_filtered_exponential(comm):
    grid = make_grid(comm, 24)
    s = initial_fields.sound_wave_density(grid, 1e-4, 2)
    state = np.concatenate([np.zeros((3, *grid.spectral_shape), complex), s[None]])
    tracers = TracerParticles(FilteredField(grid, 0.5, "quintic"), release(grid.decomposition, 3, 4, "random"), state)
    x = tracers.columns["position"][:, 0]
    # The quadratic term of the exponential is 1e-8.
    assert np.allclose(tracers.density(state), 1 + 1e-4 * gaussian_transfer(4.0, 0.5) * np.cos(2 * x), atol=1e-8)
