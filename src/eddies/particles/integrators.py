"""Time steps of particles: velocity Verlet, plain and corrected, and Runge-Kutta of second, third and fourth order."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from torch import Tensor

from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import BY_PARTICLE, Rates
from eddies.scene.integrators import SCHEMES, Scheme


class Integrator:
    """A time stepping scheme.

    `memory` holds, by name, the rates that a step passes to the next one. Their rows belong to the particles that the
    last call returned. `restore` sets `memory`. If `scheme.dense`, a call of `rates` between two steps costs nothing:
    the next step uses its result.
    """

    scheme: Scheme

    def __init__(self, dynamics: ParticleDynamics) -> None:
        self.dynamics = dynamics
        self.restore(None, {})

    def restore(self, particles: ParticleSet | None, memory: dict[str, Tensor]) -> None:
        """Continue from these particles, to which `memory` belongs."""
        self._last, self.memory = particles, memory

    def rates(self, particles: ParticleSet) -> tuple[ParticleSet, Rates]:
        """Move particles to the ranks of their slabs between two steps; return them and their rates. Collective."""
        if particles is not self._last or not self.memory:
            [particles] = self.dynamics.settle(particles)
            self.restore(particles, _remembered(self.dynamics.rates_after(0.0, particles)))
        return particles, Rates(**self.memory)

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        """The particles one time step later; collective."""
        raise NotImplementedError


class VelocityVerlet(Integrator):
    """Kick-drift-kick velocity Verlet of second order, with one evaluation of the rates per step.

    Rates may depend on velocity and density. An Euler step predicts both for the end of the step, and the rates are
    evaluated with the predicted values (Groot and Warren 1997, lambda = 1). The first half kick of the next step uses
    the same rates. A density with a rate is integrated by the trapezoidal rule. If terms give the density itself, the
    last evaluated value is kept. The shift velocity is that at the start of the step, which is accurate to first order.
    """

    scheme = SCHEMES["verlet"]

    def rates(self, particles: ParticleSet) -> tuple[ParticleSet, Rates]:
        """As `Integrator.rates`, but evaluate the rates again: `memory` holds the rates at a predicted velocity."""
        if particles is not self._last:  # the last particles are on their ranks already
            [particles] = self.dynamics.settle(particles)
        return particles, self.dynamics.rates(particles, time=self.dynamics.time)

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        particles, start = super().rates(particles)
        result, end = _kick_drift_kick(self.dynamics, particles, start, time_step)
        self.dynamics.time += time_step
        self.restore(result, _remembered(end))
        return result


class CorrectedVerlet(Integrator):
    """Velocity Verlet that evaluates the rates again at the final velocity and density (Besold et al. 2000, DPD-VV).

    Both evaluations have the same positions, and share the neighbour list and kriging weights. For rates that depend on
    velocity alone the scheme is Heun's method of second order, stable up to twice the step of velocity Verlet. The
    shift velocity is that at the start of the step, which is accurate to first order.
    """

    scheme = SCHEMES["corrected-verlet"]

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        particles, start = self.rates(particles)
        result, _ = _kick_drift_kick(self.dynamics, particles, start, time_step)
        end = self.dynamics.rates_after(time_step, result)
        self.dynamics.time += time_step
        self.restore(result, _remembered(end))
        return result


class RungeKutta(Integrator):
    """An explicit Runge-Kutta scheme. Each stage advances the state y(t) with the rates f of the previous stage:

        k_s = f(y + c_s dt k_(s-1)),    y(t + dt) = y + dt sum_s b_s k_s,

    with nodes c and weights b. Particles may change rank between stages. A step leaves `memory` empty, and a call of
    `rates` fills it.
    """

    def __init__(self, dynamics: ParticleDynamics, scheme: Scheme) -> None:
        super().__init__(dynamics)
        self.scheme = scheme

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        stage, rates = self.rates(particles)
        start = end = stage
        for number, (node, weight) in enumerate(zip(self.scheme.nodes, self.scheme.weights)):
            if number:
                stage = _advanced(start, stage, rates, node * time_step)
                stage, start, end = self.dynamics.settle(stage, start, end)
                rates = self.dynamics.rates_after(node * time_step, stage)
            end = _advanced(end, stage, rates, weight * time_step)
        self.dynamics.time += time_step
        self.restore(end, {})
        return end


#: Integrators by their names in scenes.
INTEGRATORS: dict[str, Callable[[ParticleDynamics], Integrator]] = {
    **{kind.scheme.name: kind for kind in (VelocityVerlet, CorrectedVerlet)},
    **{name: partial(RungeKutta, scheme=scheme) for name, scheme in SCHEMES.items() if scheme.nodes},
}


def _kick_drift_kick(dynamics: ParticleDynamics, particles: ParticleSet, start: Rates,
                     time_step: float) -> tuple[ParticleSet, Rates]:
    """Return the particles a step later, and the rates at their predicted velocity and density; collective.

    `start` holds the rates at the beginning of the step.
    """
    position = particles.position + time_step * (_pace(particles, start) + 0.5 * time_step * start.velocity_rate)
    predicted = replace(_kicked(particles, start, time_step), position=position)
    predicted, kicked = dynamics.settle(predicted, _kicked(particles, start, 0.5 * time_step))
    end = dynamics.rates_after(time_step, predicted)
    return _kicked(replace(kicked, position=predicted.position), end, 0.5 * time_step), end


def _remembered(rates: Rates) -> dict[str, Tensor]:
    """Return the rates that a later step may need, by name."""
    return {name: getattr(rates, name) for name in (*BY_PARTICLE, "density") if getattr(rates, name) is not None}


def _kicked(particles: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """Return particles after an Euler step of velocity and density. A density that terms give replaces the old one."""
    density = particles.density
    if rates.density is not None:
        density = rates.density
    elif rates.density_rate is not None:
        density = density + time_step * rates.density_rate
    return replace(particles, velocity=particles.velocity + time_step * rates.velocity_rate, density=density)


def _advanced(particles: ParticleSet, stage: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """Return `particles` after an Euler step of all columns, with the velocity of `stage` and its `rates`."""
    return replace(_kicked(particles, rates, time_step), position=particles.position + time_step * _pace(stage, rates))


def _pace(particles: ParticleSet, rates: Rates) -> Tensor:
    return particles.velocity if rates.shift_velocity is None else particles.velocity + rates.shift_velocity
