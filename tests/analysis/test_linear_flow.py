"""A mean flow and a mean shear: exact fits, and the pressure that drives the flow."""

import numpy as np
import pytest

from eddies.analysis.linear_flow import LinearFlow

CENTER = np.array([1.0, 2.0, 3.0])
GRADIENT = np.array([[0.5, 2.0, -1.0], [0.3, -0.8, 0.1], [1.0, 0.4, 0.3]])


@pytest.fixture
def position():
    return np.random.default_rng(1).uniform(0, 5, (200, 3))


def test_a_linear_velocity_is_found(position):
    flow = LinearFlow(CENTER, np.array([20.0, 0.0, -1.0]), GRADIENT)
    found = LinearFlow.fitted(position, flow.at(*position.T).T, CENTER)
    np.testing.assert_allclose(found.velocity, flow.velocity, atol=1e-10)
    np.testing.assert_allclose(found.gradient, GRADIENT, rtol=1e-10)
    assert flow.at(np.zeros((1, 1, 4)), np.zeros((1, 5, 1)), np.zeros((6, 1, 1))).shape == (3, 6, 5, 4)


def test_the_best_flow_without_divergence_is_found(position):
    """It has the smallest misfit: any other change without divergence makes it larger."""
    draw = np.random.default_rng(2)
    velocity = position @ (GRADIENT + np.eye(3)) + draw.standard_normal(position.shape)
    found = LinearFlow.fitted(position, velocity, CENTER)
    assert abs(np.trace(found.gradient)) < 1e-12

    def misfit(flow):
        return np.sum((flow.at(*position.T).T - velocity) ** 2)

    for _ in range(20):
        change = draw.standard_normal((3, 3)) / 100
        other = LinearFlow(CENTER, found.velocity + draw.standard_normal(3) / 100,
                           found.gradient + change - np.trace(change) / 3 * np.eye(3))
        assert misfit(other) > misfit(found)


@pytest.mark.parametrize("rows", [1, 2, 3])
def test_what_few_positions_do_not_determine_is_zero(position, rows):
    velocity = np.ones((rows, 3))
    found = LinearFlow.fitted(position[:rows], velocity, position[:rows].mean(0))
    np.testing.assert_allclose(found.at(*position[:rows].T).T, velocity, atol=1e-10)
    np.testing.assert_allclose(found.gradient, 0, atol=1e-10)


def test_the_pressure_gives_the_acceleration():
    """-grad P, by differences; a shear and a rotation accelerate as textbooks say."""
    flow, step = LinearFlow(CENTER, np.array([2.0, 0.5, -1.0]), GRADIENT), 1e-3
    place = np.array([0.3, 4.0, 1.0])
    slope = [(flow.pressure(*(place + step * axis)) - flow.pressure(*(place - step * axis)))[0] / (2 * step)
             for axis in np.eye(3)]
    np.testing.assert_allclose(flow.acceleration(*place), -np.array(slope), rtol=1e-8)
    shear, turn = np.zeros((3, 3)), np.array([[0.0, -2.0, 0.0], [2.0, 0.0, 0.0], [0.0, 0.0, 0.0]])
    shear[0, 1] = 2.0
    still = np.zeros(3)
    assert not LinearFlow(still, still, shear).pressure(*place).any()
    np.testing.assert_allclose(LinearFlow(still, still, turn).acceleration(*place), [-4 * 0.3, -4 * 4.0, 0])
