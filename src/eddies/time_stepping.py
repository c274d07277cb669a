"""Time steppers for du/dt = L u + N(u): exponential time differencing and explicit Runge-Kutta.

A stepper uses four methods of an equation: `nonlinear(state)` is N, `linear(state)` is L u, `linear_function(f, step)`
is the operator f(step L), and `combine((operator, state), ...)` applies each operator to its state and returns the sum.
States add like arrays.
"""

from collections.abc import Callable
from typing import Any

import numpy as np

ScalarFunction = Callable[[np.ndarray], np.ndarray]

# If the modulus of z is below this, the closed form of phi(z) loses digits to cancellation. The same holds for the
# divided difference of two arguments whose distance is below this.
_CANCELLATION_RADIUS = 0.5
_CONTOUR = np.exp(2j * np.pi * (np.arange(32) + 0.5) / 32)


def phi(order: int, z: np.ndarray) -> np.ndarray:
    """Return phi_n(z) = (exp(z) - sum_{j<n} z^j / j!) / z^n for the order n = 1, 2 or 3; complex, in the shape of z.

    Near zero the result is the mean of the closed form at 32 points of the unit circle around z. For an entire function
    this is exact up to the 32nd term of its Taylor series, which is negligible (Kassam and Trefethen 2005).
    """
    z = np.asarray(z, complex)
    near = np.abs(z) < _CANCELLATION_RADIUS
    result = np.empty_like(z)
    result[~near] = _phi_closed_form(order, z[~near])
    result[near] = _phi_closed_form(order, z[near][..., None] + _CONTOUR).mean(axis=-1)
    return result


def _phi_closed_form(order: int, z: np.ndarray) -> np.ndarray:
    if order == 1:
        return (np.exp(z) - 1) / z
    if order == 2:
        return (np.exp(z) - 1 - z) / z**2
    return (np.exp(z) - 1 - z - z**2 / 2) / z**3


def divided_difference(function: ScalarFunction, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return (f(z1) - f(z2)) / (z1 - z2), or its limit f'(z) where z1 = z2 = z, for an entire `function` f.

    `first` holds the arguments z1 and `second` the arguments z2. Where the two are close, Cauchy's formula is used on
    the unit circle around their mean.
    """
    first, second = np.asarray(first, complex), np.asarray(second, complex)
    close = np.abs(first - second) < _CANCELLATION_RADIUS
    result = np.empty_like(first)
    z1, z2 = first[~close], second[~close]
    result[~close] = (function(z1) - function(z2)) / (z1 - z2)
    z1, z2 = first[close][..., None], second[close][..., None]
    centre = (z1 + z2) / 2
    on_circle = function(centre + _CONTOUR)
    result[close] = (on_circle * _CONTOUR / ((centre + _CONTOUR - z1) * (centre + _CONTOUR - z2))).mean(axis=-1)
    return result


class ETDRK4:
    """Fourth-order exponential time differencing (Cox and Matthews 2002, Eqs. 26-29): exact in L, Runge-Kutta in N.

    The operators f(step L) are kept for each step size, so the number of different step sizes should be small.
    """

    evaluations = 4
    #: the largest stable Courant number; the search for the time step of a coarse grid begins with it
    most_courant = 1.4

    def __init__(self, equation: Any) -> None:
        self.equation = equation
        self._operators: dict[float, list[Any]] = {}

    def __call__(self, state: np.ndarray, step: float) -> np.ndarray:
        """Return the state after one step of size `step`."""
        full, half, q, f1, f2, f3 = self._operators.get(step) or self._prepare(step)
        N, combine = self.equation.nonlinear, self.equation.combine
        n0 = N(state)
        a = combine((half, state), (q, n0))
        na = N(a)
        nb = N(combine((half, state), (q, na)))
        na += nb
        nb *= 2
        nb -= n0
        nc = N(combine((half, a), (q, nb)))
        return combine((full, state), (f1, n0), (f2, na), (f3, nc))

    def _prepare(self, step: float) -> list[Any]:
        functions: list[ScalarFunction] = [
            np.exp,
            lambda z: np.exp(z / 2),
            lambda z: step / 2 * phi(1, z / 2),
            lambda z: step * (phi(1, z) - 3 * phi(2, z) + 4 * phi(3, z)),
            lambda z: step * (2 * phi(2, z) - 4 * phi(3, z)),
            lambda z: step * (4 * phi(3, z) - phi(2, z)),
        ]
        self._operators[step] = [self.equation.linear_function(function, step) for function in functions]
        return self._operators[step]


class RungeKutta4:
    """The classical explicit Runge-Kutta method of fourth order, for L and N alike. It serves for comparisons of error
    and run time."""

    def __init__(self, equation: Any) -> None:
        self.equation = equation

    def __call__(self, state: np.ndarray, step: float) -> np.ndarray:
        """Return the state after one step of size `step`."""
        k1 = self._rate(state)
        k2 = self._rate(state + step / 2 * k1)
        k3 = self._rate(state + step / 2 * k2)
        k4 = self._rate(state + step * k3)
        return state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)

    def _rate(self, state: np.ndarray) -> np.ndarray:
        return self.equation.linear(state) + self.equation.nonlinear(state)


STEPPERS = {"etdrk4": ETDRK4, "rk4": RungeKutta4}
