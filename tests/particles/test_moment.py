import numpy as np
import pytest
import torch

from eddies.parallel.migration import IdOrder
from eddies.particles.moment import Moment, between
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates

LENGTH = 2 * np.pi


def moment(time, position, velocity, acceleration):
    return Moment(time, 5, position(time) % LENGTH, velocity(time), acceleration(time))


def test_motion_of_fifth_degree_is_met_exactly_across_the_faces_of_the_box():
    random = np.random.default_rng(1)
    # Fourth degree in time, whose velocity is of third: what both polynomials can be.
    paths = [np.polynomial.Polynomial(random.normal(size=5)) for _ in range(6)]

    def rows(order):
        return lambda time: np.array([path.deriv(order)(time) for path in paths]).reshape(2, 3)

    before, after = (moment(time, rows(0), rows(1), rows(2)) for time in (0.1, 0.4))
    found = between(before, after, 0.23, PeriodicBox(LENGTH))
    assert found.id.tolist() == [5, 6]
    assert np.allclose(found.position, rows(0)(0.23) % LENGTH, rtol=0, atol=1e-12)
    assert np.allclose(found.velocity, rows(1)(0.23), rtol=0, atol=1e-12)


def test_motion_beside_the_fluid_is_met_where_the_shift_changes_evenly():
    """Positions go with velocity and shift, velocities with their own rate."""
    shift, velocity = (np.polynomial.Polynomial(np.random.default_rng(2).normal(size=size)) for size in (2, 4))
    position = (velocity + shift).integ()
    ends = [Moment(time, 0, np.full((1, 3), position(time)) % LENGTH, np.full((1, 3), velocity(time)),
                   np.full((1, 3), velocity.deriv()(time)), shift=np.full((1, 3), shift(time))) for time in (0.1, 0.6)]
    found = between(*ends, 0.4, PeriodicBox(LENGTH))
    assert np.allclose(found.position, position(0.4) % LENGTH, rtol=0, atol=1e-12)
    assert np.allclose(found.velocity, velocity(0.4), rtol=0, atol=1e-12)


@pytest.mark.parametrize("speed", [0.0, 40.0, 1e4])
def test_uniform_motion_at_any_speed_and_a_density_of_third_degree(speed):
    """Also many times through the box within a step."""
    position, velocity = np.array([[1.0, 2.0, 6.0]]), np.array([[speed, -0.7 * speed, 0.3 * speed]])
    density = np.polynomial.Polynomial([1.0, 0.2, -0.4, 3.0])
    before, after = (Moment(time, 0, (position + time * velocity) % LENGTH, velocity, 0 * velocity,
                            *(np.array([density.deriv(order)(time)]) for order in (0, 1))) for time in (0.2, 0.33))
    found = between(before, after, 0.3, PeriodicBox(LENGTH))
    miss = found.position.numpy() - position - 0.3 * velocity
    assert np.abs(miss - LENGTH * np.rint(miss / LENGTH)).max() < 1e-14 * max(speed, 100)
    assert np.abs(found.velocity.numpy() - velocity).max() <= 1e-15 * speed
    assert found.density.numpy() == pytest.approx(density(0.3), rel=1e-14)


def test_errors_between_steps_are_of_fourth_order():
    def errors(step):
        waves = [lambda time, order=order: np.sin(3 * time + order * np.pi / 2) * 3.0**order * np.ones((1, 3))
                 for order in range(3)]
        ends = [moment(time, *waves) for time in (0.3, 0.3 + step)]
        found = between(*ends, 0.3 + 0.4 * step, PeriodicBox(LENGTH))
        return float(np.abs(found.velocity.numpy() - waves[1](0.3 + 0.4 * step)).max())

    assert 12 < errors(0.1) / errors(0.05) < 20


@pytest.mark.mpi(1, 3)
def test_a_moment_holds_the_particles_by_their_ids(comm):
    own = torch.arange(comm.rank, 10, comm.size).flip(0)
    columns = [torch.stack([own + 0.1 * column] * 3, 1).double() for column in range(3)]
    found = Moment.of(comm, 10, 0.5, ParticleSet(own, *columns[:2]), Rates(acceleration=columns[2]))
    order = IdOrder(comm, own.numpy(), 10)
    expected = np.arange(order.start, order.stop)
    for number, name in enumerate(("position", "velocity", "acceleration")):
        assert np.allclose(getattr(found, name)[:, 0], expected + 0.1 * number)
