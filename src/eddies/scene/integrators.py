"""The time stepping schemes of particles, with the cost and the stability of their steps. This module does not need
torch."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A time stepping scheme that a scene can name.

    `nodes` and `weights` are the coefficients c and b of a Runge-Kutta scheme; other schemes have none. Each stage of a
    Runge-Kutta scheme starts at the beginning of the step and uses only the rates of the stage before. For `angle` see
    docs/methods.md.
    """

    name: str
    evaluations: int  # number of evaluations of the rates in a step
    dense: bool = True  # whether it can interpolate between steps; otherwise frames lie at the ends of steps
    # Largest k_c u' dt with which the resolved velocity follows the flow. k_c: highest resolved wavenumber, u': rms of
    # a component of the velocity, dt: time step.
    angle: float
    decay: float  # largest stable product of relaxation rate and time step
    nodes: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()


SCHEMES = {scheme.name: scheme for scheme in (
    Scheme(name="verlet", evaluations=1, dense=False, angle=0.5, decay=1.0),
    Scheme(name="corrected-verlet", evaluations=2, angle=0.5, decay=2.0),
    Scheme(name="rk2", evaluations=2, angle=1.2, decay=2.0, nodes=(0, 1 / 2), weights=(0, 1)),
    # Heun's scheme. Its stages are a third of a step apart. Equal distances suit the forecast from which each solve for
    # the resolved velocity starts.
    Scheme(name="rk3", evaluations=3, angle=1.2, decay=2.51, nodes=(0, 1 / 3, 2 / 3),
           weights=(1 / 4, 0, 3 / 4)),
    Scheme(name="rk4", evaluations=4, angle=1.6, decay=2.78, nodes=(0, 1 / 2, 1 / 2, 1),
           weights=(1 / 6, 1 / 3, 1 / 3, 1 / 6)),
)}
