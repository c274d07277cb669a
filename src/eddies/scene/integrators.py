"""The time stepping schemes of particles, by what a step of each costs and can follow: known without torch."""

from dataclasses import dataclass

#: The Courant number up to which ETDRK4 is stable. A search for the step of a coarse grid begins with it.
MOST_COURANT = 1.4


@dataclass(frozen=True, kw_only=True)
class Scheme:
    """A scheme that a scene can name.

    Parameters
    ----------
    name : its word.
    order : of its error in the step.
    evaluations : of the rates in a step.
    at_a_place : so many of these are at the same places, where others move particles for each.
    dense : whether it knows the rates at the ends of steps, so that what is between can be told from them; if not,
        frames lie at ends of steps.
    angle : k_c u' times the step up to which a velocity that is resolved up to k_c follows the flow: docs/closure.md.
    decay : the largest rate times step of what relaxes.
    iterations : of the solve for a resolved velocity in an evaluation, which starts from what is foreseen, at about the
        longest steps that the flow allows: docs/closure.md.
    nodes, weights : c and b of a Runge-Kutta scheme whose stages each go from the step's start along the rates of the
        one before; none of others.
    """

    name: str
    order: int
    evaluations: int
    at_a_place: int = 1
    dense: bool = True
    angle: float
    decay: float
    iterations: float
    nodes: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()


SCHEMES = {scheme.name: scheme for scheme in (
    Scheme(name="verlet", order=2, evaluations=1, dense=False, angle=0.5, decay=1.0, iterations=1.0),
    Scheme(name="corrected-verlet", order=2, evaluations=2, at_a_place=2, angle=0.5, decay=2.0, iterations=1.0),
    Scheme(name="rk2", order=2, evaluations=2, angle=1.2, decay=2.0, iterations=1.2, nodes=(0, 1 / 2), weights=(0, 1)),
    # Heun's scheme: its stages are a third of a step apart, which suits a solve that starts from what the stages before
    # foresee.
    Scheme(name="rk3", order=3, evaluations=3, angle=1.2, decay=2.51, iterations=3.0, nodes=(0, 1 / 3, 2 / 3),
           weights=(1 / 4, 0, 3 / 4)),
    Scheme(name="rk4", order=4, evaluations=4, angle=1.6, decay=2.78, iterations=6.5, nodes=(0, 1 / 2, 1 / 2, 1),
           weights=(1 / 6, 1 / 3, 1 / 3, 1 / 6)),
)}
