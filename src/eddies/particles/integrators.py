"""Time steps of particles: velocity Verlet, and Runge-Kutta of second and fourth order."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_set import ParticleSet


class Integrator:
    """A time stepping scheme; `memory` is what it carries from one step to the next besides the particles."""

    def __init__(self, dynamics: ParticleDynamics) -> None:
        self.dynamics = dynamics
        self.memory: dict[str, Tensor] = {}

    def restore(self, particles: ParticleSet, memory: dict[str, Tensor]) -> None:
        """Go on from a checkpoint: `memory` belongs to these very particles."""

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        """The particles one time step later; collective."""
        raise NotImplementedError


class VelocityVerlet(Integrator):
    """Kick-drift-kick velocity Verlet of second order, one evaluation of the rates a step.

    Rates may depend on velocity and density: they are evaluated at the velocity and density predicted for the
    end of the step by an Euler step, v + dt a (Groot and Warren 1997, with lambda = 1), and serve the next
    step's first half kick as well. A density with a rate is integrated by the trapezoidal rule; one given by
    a closure is left as last evaluated.

    `memory` holds those rates, rows as in the particles last returned: a checkpoint must keep it, and
    `restore` gives it back. For any other particles than those last returned the rates are evaluated anew.
    """

    def __init__(self, dynamics: ParticleDynamics) -> None:
        super().__init__(dynamics)
        self._last: ParticleSet | None = None

    def restore(self, particles: ParticleSet, memory: dict[str, Tensor]) -> None:
        self._last, self.memory = particles, memory

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        memory = self.memory if particles is self._last else {}
        particles, memory = self.dynamics.settle(particles, memory)
        start = memory or self.dynamics.rates(particles)
        half = particles.velocity + 0.5 * time_step * start["velocity"]
        predicted = replace(
            _advanced(particles, start, time_step), position=particles.position + time_step * half
        )
        end = self.dynamics.rates(predicted)
        kicked = _advanced(_advanced(particles, start, 0.5 * time_step), end, 0.5 * time_step)
        result = replace(kicked, position=predicted.position)
        self.restore(result, {name: rate for name, rate in end.items() if name != "closure_density"})
        return result


class Midpoint(Integrator):
    """Runge-Kutta of second order, two evaluations of the rates a step."""

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        start, _ = self.dynamics.settle(particles)
        middle = _advanced(start, _all_rates(self.dynamics, start), 0.5 * time_step)
        return _advanced(start, _all_rates(self.dynamics, middle), time_step)


class RungeKutta4(Integrator):
    """The classical Runge-Kutta scheme of fourth order, four evaluations of the rates a step."""

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        start, _ = self.dynamics.settle(particles)
        rates = [_all_rates(self.dynamics, start)]
        for fraction in (0.5, 0.5, 1.0):
            stage = _advanced(start, rates[-1], fraction * time_step)
            rates.append(_all_rates(self.dynamics, stage))
        result = start
        for weight, rate in zip((1, 2, 2, 1), rates):
            result = _advanced(result, rate, weight * time_step / 6)
        return result


INTEGRATORS = {"verlet": VelocityVerlet, "rk2": Midpoint, "rk4": RungeKutta4}


def _all_rates(dynamics: ParticleDynamics, particles: ParticleSet) -> dict[str, Tensor]:
    """The rates, with that of the position."""
    return {**dynamics.rates(particles), "position": particles.velocity}


def _advanced(particles: ParticleSet, rates: dict[str, Tensor], time_step: float) -> ParticleSet:
    """Each column that has a rate moved on by one Euler step; a density given by a closure replaced."""
    columns = {}
    for name, rate in rates.items():
        if name == "closure_density":
            columns["density"] = rate
        else:
            columns[name] = getattr(particles, name) + time_step * rate
    return replace(particles, **columns)
