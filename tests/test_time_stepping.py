import numpy as np
import pytest

from eddies.time_stepping import ETDRK4, RungeKutta4, divided_difference, phi


@pytest.mark.parametrize("order", [1, 2, 3])
def test_phi_functions_satisfy_their_recurrence_and_their_limit(order):
    # phi_n(z) = z phi_{n+1}(z) + 1/n!, checked across the switch between the closed form and the contour.
    z = np.array([0, 1e-12, 1e-3, 0.49, 0.51, -0.3 + 0.3j, 5j, -40.0, -3 + 30j])
    lower = np.exp(z) if order == 1 else phi(order - 1, z)
    factorial = [1, 1, 2][order - 1]
    assert np.abs(z * phi(order, z) + 1 / factorial - lower).max() < 1e-14
    assert phi(order, np.array([0.0]))[0] == pytest.approx(1 / [1, 2, 6][order - 1], rel=1e-14)


def test_divided_difference_tends_to_the_derivative():
    z = np.array([0.3 + 2j, -5.0])
    for gap in (0, 1e-14, 1e-8, 0.1, 0.6):
        exact = np.exp(z) if gap < 1e-12 else np.exp(z) * np.expm1(gap) / gap
        assert np.abs(divided_difference(np.exp, z + gap, z) - exact).max() < 1e-13


class Oscillator:
    """u' = L u + u^2 with a diagonal complex L: the steppers' test problem."""

    rates = np.array([-1.0, -50.0, 8j])

    def nonlinear(self, state):
        return state**2

    def linear(self, state):
        return self.rates * state

    def linear_function(self, function, step):
        return function(step * self.rates)

    def combine(self, *terms):
        return sum(factor * state for factor, state in terms)

    def exact(self, state, time):
        # Bernoulli's equation: 1/u is linear in exp(-L t).
        return 1 / ((1 / state + 1 / self.rates) * np.exp(-self.rates * time) - 1 / self.rates)


@pytest.mark.parametrize("stepper, steps", [(ETDRK4, (10, 20, 40)), (RungeKutta4, (100, 200, 400))])
def test_order_four(stepper, steps):
    equation, start = Oscillator(), np.array([0.5, 0.4, 0.3 + 0.1j])
    errors = []
    for count in steps:
        state, step = start, stepper(equation)
        for _ in range(count):
            state = step(state, 1.0 / count)
        errors.append(np.abs(state - equation.exact(start, 1.0)).max())
    assert np.log2(errors[0] / errors[1]) > 3.8 and np.log2(errors[1] / errors[2]) > 3.8
