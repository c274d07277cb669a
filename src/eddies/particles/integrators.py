"""Time steps of particles: velocity Verlet, and Runge-Kutta of second and fourth order."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import Rates


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
    step's first half kick as well. A density with a rate is integrated by the trapezoidal rule; one that terms give
    is left as last evaluated.

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
        start = Rates(**memory) if memory else self.dynamics.rates(particles)
        position = particles.position + time_step * (particles.velocity + 0.5 * time_step * start.acceleration)
        end = self.dynamics.rates(replace(_kicked(particles, start, time_step), position=position))
        kicked = _kicked(_kicked(particles, start, 0.5 * time_step), end, 0.5 * time_step)
        result = replace(kicked, position=position)
        remembered = {name: getattr(end, name) for name in REMEMBERED}
        self.restore(result, {name: rate for name, rate in remembered.items() if rate is not None})
        return result


class Midpoint(Integrator):
    """Runge-Kutta of second order, two evaluations of the rates a step."""

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        start, _ = self.dynamics.settle(particles)
        middle = _advanced(start, start, self.dynamics.rates(start), 0.5 * time_step)
        return _advanced(start, middle, self.dynamics.rates(middle), time_step)


class RungeKutta4(Integrator):
    """The classical Runge-Kutta scheme of fourth order, four evaluations of the rates a step."""

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        start, _ = self.dynamics.settle(particles)
        stages = [(start, self.dynamics.rates(start))]
        for fraction in (0.5, 0.5, 1.0):
            stage = _advanced(start, *stages[-1], fraction * time_step)
            stages.append((stage, self.dynamics.rates(stage)))
        result = start
        for weight, stage in zip((1, 2, 2, 1), stages):
            result = _advanced(result, *stage, weight * time_step / 6)
        return result


INTEGRATORS = {"verlet": VelocityVerlet, "rk2": Midpoint, "rk4": RungeKutta4}
REMEMBERED = ("acceleration", "density_rate")


def _kicked(particles: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """Velocity and, where it has a rate, density moved on by one Euler step; a density that terms give replaced."""
    density = particles.density
    if rates.density is not None:
        density = rates.density
    elif rates.density_rate is not None:
        density = density + time_step * rates.density_rate
    return replace(particles, velocity=particles.velocity + time_step * rates.acceleration, density=density)


def _advanced(particles: ParticleSet, stage: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """All columns moved on by one Euler step with the velocity and the rates of a stage."""
    return replace(_kicked(particles, rates, time_step), position=particles.position + time_step * stage.velocity)
