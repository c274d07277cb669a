import numpy as np
import pytest
import torch

from eddies.parallel.migration import IdOrder
from eddies.particles.moment import Moment, between
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates

LENGTH = 2 * np.pi
BOX = PeriodicBox(LENGTH)


def polynomials(size, count=6, seed=1):
    """Rows (count/3, 3) of random polynomials of time with `size` coefficients, and of their derivatives."""
    paths = [np.polynomial.Polynomial(each) for each in np.random.default_rng(seed).normal(size=(count, size))]
    return lambda time, order=0: np.array([path.deriv(order)(time) for path in paths]).reshape(-1, 3)


def test_motion_of_fourth_degree_is_exact_across_the_faces_of_the_box():
    """A uniform part of the velocity moves the particles many times through the box; densities are cubic."""
    own = polynomials(5)  # its velocity is of third degree, as exact as the interpolation allows
    density = np.polynomial.Polynomial([1.0, 0.2, -0.4, 3.0])

    def path(time, order=0):
        return own(time, order) + (100 * time, 100, 0)[order]

    ends = [Moment(time, 5, path(time) % LENGTH, path(time, 1), path(time, 2),
                   *(np.full(2, density.deriv(order)(time)) for order in (0, 1))) for time in (0.1, 0.4)]
    found = between(*ends, 0.23, BOX)
    assert found.id.tolist() == [5, 6]
    assert np.allclose(found.position, path(0.23) % LENGTH, rtol=0, atol=1e-12)
    assert np.allclose(found.velocity, path(0.23, 1), rtol=0, atol=1e-12)
    assert found.density.numpy() == pytest.approx(density(0.23), rel=1e-14)


def test_motion_relative_to_the_fluid_is_exact_for_a_linear_shift():
    """Positions follow velocity plus shift; velocities follow their own rate."""
    shift, velocity = polynomials(2, seed=2), polynomials(4, seed=3)

    def position(time):  # integral of both by quadrature
        nodes, weights = np.polynomial.legendre.leggauss(4)
        return sum(w * time / 2 * (shift(time * (x + 1) / 2) + velocity(time * (x + 1) / 2))
                   for x, w in zip(nodes, weights))

    ends = [Moment(time, 0, position(time) % LENGTH, velocity(time), velocity(time, 1), shift=shift(time))
            for time in (0.1, 0.6)]
    found = between(*ends, 0.4, BOX)
    assert np.allclose(found.position, position(0.4) % LENGTH, rtol=0, atol=1e-12)
    assert np.allclose(found.velocity, velocity(0.4), rtol=0, atol=1e-12)


@pytest.mark.mpi(1, 3)
def test_a_moment_holds_the_particles_in_the_order_of_their_ids(comm):
    own = torch.arange(comm.rank, 10, comm.size).flip(0)
    columns = [torch.stack([own + 0.1 * column] * 3, 1).double() for column in range(3)]
    found = Moment.of(comm, 10, 0.5, ParticleSet(own, *columns[:2]), Rates(acceleration=columns[2]))
    order = IdOrder(comm, own.numpy(), 10)
    for number, name in enumerate(("position", "velocity", "acceleration")):
        assert np.allclose(getattr(found, name)[:, 0], np.arange(order.start, order.stop) + 0.1 * number)
