"""Time steps of particles: velocity Verlet, plain and corrected, and Runge-Kutta of second, third and fourth order."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

from torch import Tensor

from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import BY_PARTICLE, Rates
from eddies.scene.integrators import SCHEMES, Scheme


class Integrator:
    """A time stepping scheme; `memory` is what it carries from one step to the next besides the particles and the
    state of the dynamics, with rows as in the particles last returned; `restore` gives it back. Where the scheme is
    dense the next step begins with the `rates` that somebody has asked for."""

    scheme: Scheme

    def __init__(self, dynamics: ParticleDynamics) -> None:
        self.dynamics = dynamics
        self.restore(None, {})

    def restore(self, particles: ParticleSet | None, memory: dict[str, Tensor]) -> None:
        """Go on from these very particles, to which `memory` belongs."""
        self._last, self.memory = particles, memory

    def rates(self, particles: ParticleSet) -> tuple[ParticleSet, Rates]:
        """Particles between two steps, on the ranks of their slabs, and their rates; collective."""
        if particles is not self._last or not self.memory:
            particles, _ = self.dynamics.settle(particles)
            rates = self.dynamics.rates_after(0.0, particles)
            self.restore(particles, _remembered(rates))
        return particles, Rates(**self.memory)

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        """The particles one time step later; collective."""
        raise NotImplementedError


class VelocityVerlet(Integrator):
    """Kick-drift-kick velocity Verlet of second order, one evaluation of the rates a step.

    Rates may depend on velocity and density: they are evaluated at the velocity and density predicted for the
    end of the step by an Euler step, v + dt a (Groot and Warren 1997, with lambda = 1), and serve the next
    step's first half kick as well. A density with a rate is integrated by the trapezoidal rule; one that terms give
    is left as last evaluated. A shift velocity is that of the step's start, of first order.

    `memory` holds those rates. They are evaluated anew for any other particles than those last returned.
    """

    scheme = SCHEMES["verlet"]

    def rates(self, particles: ParticleSet) -> tuple[ParticleSet, Rates]:
        """Evaluated for themselves: those of the memory belong to the predicted velocity."""
        if particles is not self._last:  # else they are where they belong, and the memory is theirs
            particles, _ = self.dynamics.settle(particles)
        return particles, self.dynamics.rates(particles, time=self.dynamics.time)

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        """The particles one time step later; collective."""
        if particles is self._last and self.memory:
            start = Rates(**self.memory)
        else:
            particles, _ = self.dynamics.settle(particles)
            start = self.dynamics.rates_after(0.0, particles)
        result, end = _kick_drift_kick(self.dynamics, particles, start, time_step)
        self.dynamics.time += time_step
        self.restore(result, _remembered(end))
        return result


class CorrectedVerlet(Integrator):
    """Velocity Verlet of which the rates at the end are evaluated again at the velocity and density that it has come
    to, for the next step (Besold et al. 2000, DPD-VV).

    Both evaluations are at the same places, so that what depends on these alone, lists and weights of neighbours,
    serves both. For rates that depend on velocity alone it is Heun's method of second order, stable up to twice the
    step of velocity Verlet. A shift velocity is that of the step's start, of first order. `memory` holds the rates at
    the particles last returned.
    """

    scheme = SCHEMES["corrected-verlet"]

    def step(self, particles: ParticleSet, time_step: float) -> ParticleSet:
        """The particles one time step later; collective."""
        particles, start = self.rates(particles)
        result, _ = _kick_drift_kick(self.dynamics, particles, start, time_step)
        end = self.dynamics.rates_after(time_step, result)
        self.dynamics.time += time_step
        self.restore(result, _remembered(end))
        return result


class RungeKutta(Integrator):
    """An explicit Runge-Kutta scheme in which each stage goes from the step's start along the rates of the one before:

        k_s = f(y + c_s dt k_(s-1)),    y + dt sum_s b_s k_s,

    with c and b the nodes and weights of the scheme.

    Particles change rank between stages. `memory` holds the rates at the particles last returned where `rates` was
    asked for them.
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
                stage, start, end = self._settled(stage, start, end)
                rates = self.dynamics.rates_after(node * time_step, stage)
            end = _advanced(end, stage, rates, weight * time_step)
        self.dynamics.time += time_step
        self.restore(end, {})
        return end

    def _settled(self, stage: ParticleSet, *others: ParticleSet) -> list[ParticleSet]:
        """A stage on the ranks of its slabs, and other columns of its particles beside it."""
        companions = {f"{number} {name}": column for number, other in enumerate(others)
                      for name, column in other.columns().items() if name != "id"}
        stage, moved = self.dynamics.settle(stage, companions)
        found: list[dict[str, Tensor]] = [{"id": stage.id} for _ in others]
        for place, column in moved.items():
            number, name = place.split(" ", 1)
            found[int(number)][name] = column
        return [stage, *(ParticleSet(**columns) for columns in found)]


REMEMBERED = (*BY_PARTICLE, "density")
#: By the words of scenes.
INTEGRATORS: dict[str, Callable[[ParticleDynamics], Integrator]] = {
    **{kind.scheme.name: kind for kind in (VelocityVerlet, CorrectedVerlet)},
    **{name: partial(RungeKutta, scheme=scheme) for name, scheme in SCHEMES.items() if scheme.nodes},
}


def _kick_drift_kick(dynamics: ParticleDynamics, particles: ParticleSet, start: Rates,
                     time_step: float) -> tuple[ParticleSet, Rates]:
    """Particles a step later, and the rates at their predicted velocity and density there; collective."""
    position = particles.position + time_step * (_pace(particles, start) + 0.5 * time_step * start.velocity_rate)
    predicted = replace(_kicked(particles, start, time_step), position=position)
    kicked = _kicked(particles, start, 0.5 * time_step)
    columns = {name: column for name, column in kicked.columns().items() if name not in ("id", "position")}
    predicted, columns = dynamics.settle(predicted, columns)
    end = dynamics.rates_after(time_step, predicted)
    return _kicked(replace(predicted, **columns), end, 0.5 * time_step), end


def _remembered(rates: Rates) -> dict[str, Tensor]:
    """Those that a later step may want, by name."""
    found = {name: getattr(rates, name) for name in REMEMBERED}
    return {name: rate for name, rate in found.items() if rate is not None}


def _kicked(particles: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """Velocity and, where it has a rate, density moved on by one Euler step; a density that terms give replaced."""
    density = particles.density
    if rates.density is not None:
        density = rates.density
    elif rates.density_rate is not None:
        density = density + time_step * rates.density_rate
    return replace(particles, velocity=particles.velocity + time_step * rates.velocity_rate, density=density)


def _advanced(particles: ParticleSet, stage: ParticleSet, rates: Rates, time_step: float) -> ParticleSet:
    """All columns moved on by one Euler step with the velocity and the rates of a stage."""
    return replace(_kicked(particles, rates, time_step), position=particles.position + time_step * _pace(stage, rates))


def _pace(particles: ParticleSet, rates: Rates) -> Tensor:
    """dx/dt."""
    return particles.velocity if rates.shift_velocity is None else particles.velocity + rates.shift_velocity
