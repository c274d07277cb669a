"""Sums over few and many neighbours, and steps of known stiffness."""

import math

import numpy as np
import pytest
import torch
from extreme_cases import PLANES, SKIN, acceleration, random_points, set_up, units
from mpi4py import MPI

from eddies.particles.context import REGULARISATION, expected_moment
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS
from eddies.scene.integrators import SCHEMES
from tests.particles.configurations import LENGTH, Field, distributed, lattice, of_terms
from tests.particles.configurations import model as model_of

every_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)


def sound_model(total, neighbors=24.0):
    """Linear gas dynamics: dv/dt = -c^2 grad rho / rho_0 by corrected differences, d rho/dt = -rho_0 div v by SPH."""
    linear = model_of({"pairs": dict(hidden=(1,)), "continuity": {}}, units(total, neighbors))
    flow, small, network = linear.flow.scales, 1e-3, linear.terms["pairs"].network  # tanh is linear for small arguments
    gain = flow.sound_speed**2 * flow.density / (flow.density_mean * flow.acceleration * flow.filter_width)
    with torch.no_grad():
        network.weights[0][:] = torch.tensor([[-small, small, 0, 0, 0]])
        network.weights[1][:] = torch.tensor([[gain / small], [0]])
    return linear


@pytest.mark.mpi(1)
@pytest.mark.parametrize("neighbors", [30, 120])
def test_moments_correct_differences_among_30_to_120_neighbours(comm, neighbors):
    """-c^2 grad rho of a linear density, where the cutoff lies within the box, by random neighbours."""
    model, position = sound_model(1000, neighbors), random_points(1000)
    slope = torch.tensor([1e-3, -2e-3, 0.5e-3], dtype=torch.float64) * model.flow.scales.density
    found = acceleration(comm, model, position, velocity=torch.zeros_like(position),
                         density=1 + (position - math.pi) @ slope)
    inside = ((position > model.flow.cutoff) & (position < LENGTH - model.flow.cutoff)).all(1)
    exact = -model.flow.scales.sound_speed**2 * slope
    assert inside.any() and (found[inside] - exact).norm(dim=1).median() < 2 * REGULARISATION * exact.norm()


# Steps of known stiffness. A step multiplies a wave or a mode by `amplification` of z = step times its rate.


def amplification(integrator, system, z):
    """Spectral radius of one step: "oscillator" x'' = -x, "drag" v' = -v, "sound" y' = iy, at the step z."""
    # Where no rate depends on positions, corrected Verlet is Heun's method of second order.
    corrected = integrator == "corrected-verlet" and system != "oscillator"
    if corrected or integrator.startswith("rk"):
        z, order = -z if system == "drag" else 1j * z, 2 if corrected else int(integrator[2:])
        return abs(sum(z**n / math.factorial(n) for n in range(order + 1)))
    if system == "oscillator":  # positions and forces leapfrog
        return max(abs(np.linalg.eigvals([[1 - z**2 / 2, z], [-z + z**3 / 4, 1 - z**2 / 2]])))
    # The rate at the velocity (or density) predicted by Euler's rule is averaged with the last such rate. For the
    # predictions this is the second-order rule of Adams and Bashforth.
    z = -z if system == "drag" else 1j * z
    return max(abs(np.roots([1, -(1 + 1.5 * z), 0.5 * z])))


def boundary(integrator, system, growth):
    """The smallest step z at which a mode grows by more than `growth` a step."""
    steps = np.linspace(0, 4, 4001)[1:]
    return float(steps[np.argmax([amplification(integrator, system, z) > 1 + growth for z in steps])])


def particle_growth(integrator, z, acceleration_of, restoring, count=32):
    """Growth a step of one particle with this acceleration, from the last two quarters of the steps."""
    position, velocity = torch.full((1, 3), math.pi, dtype=torch.float64), torch.full((1, 3), 1e-9).double()
    slab, particles = distributed(MPI.COMM_SELF, position, velocity, planes=PLANES)
    stepper, sizes = INTEGRATORS[integrator](ParticleDynamics(slab, of_terms(Field(acceleration_of)), SKIN)), []
    for _ in range(count):
        particles = stepper.step(particles, z)
        away = float(particles.position[0, 0] - position[0, 0]) if restoring else 0.0
        sizes.append(math.hypot(away, float(particles.velocity[0, 0])))
    quarter = count // 4
    return (max(sizes[-quarter:]) / max(sizes[-2 * quarter : -quarter])) ** (1 / quarter)


def wavenumbers_seen(model, side, waves):
    """The k that sums over neighbours give a wave along x on a lattice: in the force sum w x sin(kx) / sum w x^2, in
    the rate of density -m sum W' x sin(kx) / r."""
    reach = math.ceil(model.flow.cutoff / (LENGTH / side))
    offsets = np.argwhere(np.ones((2 * reach + 1,) * 3)) - reach
    x = offsets[np.any(offsets, axis=1)] * LENGTH / side
    weight = np.clip(1 - np.sum(x**2, axis=1) / model.flow.cutoff**2, 0, None) ** 2
    kept = REGULARISATION * expected_moment(model.flow.neighbors, model.flow.cutoff)
    moved = x[:, 0] * np.sin(waves * x[:, 0])
    slope = np.sum(weight * moved) / (np.sum(weight * x[:, 0] ** 2) + kept)
    distance = np.linalg.norm(x, axis=1)
    fall = model.terms["continuity"].kernel.derivative(torch.from_numpy(distance)).numpy() / distance
    return slope, -model.flow.particle_mass * np.sum(fall * moved)


@torch.no_grad()
def sound_growth(integrator, z, count=20, side=7, waves=2):
    """Growth a step of a standing sound wave of pairs on a lattice; z: step times frequency."""
    model, position = sound_model(side**3), lattice(side)
    density = 1 + 1e-6 * model.flow.scales.density * torch.cos(waves * position[:, 0])
    dynamics, particles = set_up(MPI.COMM_SELF, model, position, torch.zeros_like(position), density)
    stepper, sizes, c = INTEGRATORS[integrator](dynamics), [], model.flow.scales.sound_speed
    of_force, of_density = wavenumbers_seen(model, side, waves)
    for _ in range(count):
        particles = stepper.step(particles, z / (c * math.sqrt(of_force * of_density)))
        # Other waves grow out of round-off; the projection measures this one alone.
        phase = waves * particles.position[:, 0]
        contrast = float((particles.density - 1) @ torch.cos(phase))
        sizes.append(math.hypot(contrast * c * math.sqrt(of_force / of_density),
                                float(particles.velocity[:, 0] @ torch.sin(phase))))
    return (sizes[-1] / sizes[count // 2]) ** (1 / (count - 1 - count // 2))


SYSTEMS = {
    "oscillator": lambda integrator, z: particle_growth(integrator, z, lambda x, v: math.pi - x, restoring=True),
    "drag": lambda integrator, z: particle_growth(integrator, z, lambda x, v: -v, restoring=False),
    "sound": sound_growth,
}


@pytest.mark.mpi(1)
@pytest.mark.parametrize("system", SYSTEMS)
@every_integrator
def test_a_step_beyond_the_stability_boundary_grows_as_theory_says(comm, integrator, system):
    limit = boundary(integrator, system, 0.01)
    assert SYSTEMS[system](integrator, 0.97 * limit) < 1.01 < SYSTEMS[system](integrator, 1.03 * limit)
    if system != "oscillator":
        grown = SYSTEMS[system](integrator, 1.1 * limit)
        assert grown == pytest.approx(amplification(integrator, system, 1.1 * limit), rel=1e-4)


@every_integrator
def test_the_record_of_an_integrator_has_its_limit_for_relaxation(integrator):
    assert SCHEMES[integrator].decay == pytest.approx(boundary(integrator, "drag", 1e-9), rel=3e-3)
