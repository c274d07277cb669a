"""Particles in extreme places and states, steps of known stiffness, and the report of a run that must fail."""

import math
import re

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import any_rank
from eddies.particles.context import REGULARISATION, expected_moment
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.scene.integrators import SCHEMES
from eddies.scene.terms import PRESETS
from tests.particles.configurations import (
    LENGTH, OWN_DENSITY, Field, by_id, distributed, dynamics_of, lattice, of_terms,
)
from tests.particles.configurations import model as model_of

TOTAL, PLANES, SKIN = 125, 9, 0.1  # 1.8 planes of the grid per particle and direction
# Of a solve: a fixed number, so that ranks and precisions agree; small, so that ill-posed arrangements do not amplify
# rounding.
ITERATIONS = 6
CLOSURES = {
    "pressure": {"pressure": {}, "pairs": {}},
    "resolved + pairs": PRESETS["resolved + pairs"],
    "own density": {**OWN_DENSITY, "eddy-viscosity": dict(form="monaghan")},
    "paper": {"pairs": dict(basis="paper", hidden=(8, 8)), "density-flux": dict(hidden=(8, 8)),
              "eddy-viscosity": dict(form="two-sided", basis="paper")},
    "wcsph": PRESETS["wcsph"],
    "local": PRESETS["local"],
}
every_closure = pytest.mark.parametrize("kind", ["resolved + pairs", "paper", "wcsph", "local"])


def units(total=TOTAL, neighbors=24.0, mach=0.1):
    """Units of turbulence with v_rms = 1 and the largest eddies of the box; density fluctuations scale with M_t^2."""
    spacing = LENGTH / round(total ** (1 / 3))
    scales = ReferenceScales(
        filter_width=2 * spacing, spacing=spacing, velocity=1.0, density_mean=1.0, density=0.3 * mach**2,
        acceleration=3.0, density_rate=0.5 * mach**2, sound_speed=math.sqrt(3) / mach,
        viscosity=0.02)
    return FlowUnits(scales, spacing * (neighbors * 3 / (4 * math.pi)) ** (1 / 3), neighbors)


def network_model(kind, mach=0.1):
    """A model with initial weights."""
    return model_of(CLOSURES[kind], units(mach=mach))


def has_grid(kind):
    """Whether the model has a force from its grid."""
    return "resolved" in network_model(kind).reads


def flow_velocity(position):
    """The ABC flow, v_rms = 1."""
    x, y, z = position.T
    return torch.stack([torch.sin(z) + torch.cos(y), torch.sin(x) + torch.cos(z), torch.sin(y) + torch.cos(x)], dim=1)


def random_points(total=TOTAL, seed=5):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, LENGTH, (total, 3)))


def set_up(comm, model, position, velocity=None, density=None, dtype=torch.float64):
    """Dynamics and this rank's particles; with the velocity of the flow and the mean density unless given."""
    velocity = flow_velocity(position) if velocity is None else velocity
    density = torch.ones(len(position), dtype=torch.float64) if density is None else density
    slab, particles = distributed(comm, position, velocity, density, planes=PLANES)
    return dynamics_of(slab, model.to(dtype), SKIN, ITERATIONS, dtype=dtype), particles


@torch.no_grad()
def acceleration(comm, model, position, **given):
    """Accelerations of all particles by id, on every rank."""
    dynamics, particles = set_up(comm, model, position, **given)
    [particles] = dynamics.settle(particles)
    return by_id(comm, particles, dynamics.rates(particles).acceleration, len(position))


@torch.no_grad()
def advance(dynamics, particles, integrator, step, count):
    stepper = INTEGRATORS[integrator](dynamics)
    for _ in range(count):
        particles = stepper.step(particles, step)
    return particles


ARRANGEMENTS = {
    "in 1 % of the box": random_points() * 0.01 ** (1 / 3),
    "in 1 % of the box, across a corner": (random_points() - math.pi) * 0.01 ** (1 / 3) % LENGTH,
    "empty octant": random_points(2 * TOTAL)[(random_points(2 * TOTAL) > math.pi).any(1)][:TOTAL],
    "in a plane": random_points() * torch.tensor([1.0, 1.0, 0.0]),
    "on a line": random_points() * torch.tensor([1.0, 0.0, 0.0]),
    "all at one point": torch.ones(TOTAL, 3, dtype=torch.float64),
}


# ---- places


def is_finite(comm, particles):
    columns = [column for name, column in particles.columns().items() if name != "id"]
    return not any_rank(comm, not all(bool(torch.isfinite(column).all()) for column in columns))


@pytest.mark.mpi(1)
@every_closure
def test_nearly_coincident_particles_move_as_coincident_ones(comm, kind):
    """Each of the first particles has a twin; one pair lies at the origin."""
    model, single = network_model(kind), random_points(TOTAL // 2)
    single[0] = 0.0
    velocity = flow_velocity(torch.cat([single, single]))
    together = acceleration(comm, model, torch.cat([single, single]), velocity=velocity)
    for separation in (1e-300, 1e-8):  # in mean spacings
        shift = torch.tensor([separation * model.flow.scales.spacing, 0.0, 0.0], dtype=torch.float64)
        position = torch.cat([single, single + shift])
        apart = acceleration(comm, model, position, velocity=velocity)
        # Accelerations vary over the cutoff, here two spacings, by a few times themselves; where the few neighbours
        # are nearly in a plane, by a hundred times.
        assert (apart - together).abs().max() <= (300 * separation + 1e-12) * together.abs().max()
        assert is_finite(comm, advance(*set_up(comm, model, position, velocity), "verlet", 0.01, 2))


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name, kind", [
    ("in 1 % of the box", "resolved + pairs"), ("in 1 % of the box, across a corner", "own density"),
    ("empty octant", "local"), ("in a plane", "local"), ("on a line", "resolved + pairs"),
    ("all at one point", "resolved + pairs"), ("all at one point", "own density"), ("all at one point", "local")])
def test_any_arrangement_has_finite_rates_that_are_the_same_on_all_ranks(comm, kind, name):
    model, position = network_model(kind), ARRANGEMENTS[name]
    alone, here = (acceleration(group, model, position) for group in (MPI.COMM_SELF, comm))
    largest = alone.abs().max().clamp_min(model.flow.scales.acceleration)
    assert (here - alone).abs().max() < 1e-9 * largest
    assert is_finite(comm, advance(*set_up(comm, model, position), "rk2", 0.01, 1))


@pytest.mark.mpi(2)
@every_closure
def test_few_particles_move_straight_on(comm, kind):
    """One particle on each rank; with a pressure, by which two push each other from any distance, one in all."""
    total = 1 if has_grid(kind) else 2
    position = torch.full((total, 3), 1.0, dtype=torch.float64)
    position[:, 2] = (torch.arange(total) + 0.25) * LENGTH / total
    dynamics, particles = set_up(comm, network_model(kind), position)
    for integrator in INTEGRATORS:
        end = advance(dynamics, particles, integrator, 0.02, 2)
        straight = position + 0.04 * flow_velocity(position)
        off = dynamics.box.displacement(by_id(comm, end, end.position, total), straight)
        assert off.abs().max() < 1e-12, integrator


@pytest.mark.mpi(1)
@every_closure
def test_a_lattice_at_rest_stays_at_rest(comm, kind):
    position = lattice(5)
    for dtype, most in ((torch.float64, 1e-13), (torch.float32, 1e-5)):
        model = network_model(kind)
        dynamics, particles = set_up(comm, model, position, torch.zeros_like(position), dtype=dtype)
        end = advance(dynamics, particles, "verlet", 0.02, 3)
        # The pressures of WCSPH are c^2, a hundred times the accelerations, and cancel.
        most *= 100 if kind == "wcsph" else 1
        assert end.velocity.abs().max() < most * 0.02 * model.flow.scales.acceleration


# ---- states

FAST = 1000 * units().scales.sound_speed  # 1.7e4 v_rms: its round-off is 2e-12


def complaint_after(comm, model, step, count, integrator="rk4"):
    """The first complaint about the state after some steps, on all ranks, by the limits of a rollout; the state."""
    dynamics, particles = set_up(comm, model, random_points())
    try:
        end = advance(dynamics, particles, integrator, step, count)
    except HaloError as error:
        return str(error), None
    scales = model.flow.scales
    limits = Limits(30 * scales.velocity, torch.zeros(3), scales.density_mean, 300 * scales.density)
    fault = find_fault(end, limits, dynamics.box, step=1, rank=comm.rank)
    return first_complaint(comm, fault), by_id(comm, end, end.velocity, len(random_points()))


@pytest.mark.mpi(1)
@every_closure
def test_a_uniform_velocity_of_a_thousand_times_sound_changes_no_force(comm, kind):
    """Differences of velocities keep the round-off of the velocity."""
    model, uniform = network_model(kind), torch.tensor([0.5, -0.3, 1.0]) * FAST
    for position in (random_points(), *([ARRANGEMENTS["all at one point"]] if has_grid(kind) else ())):
        still = acceleration(comm, model, position)
        moving = acceleration(comm, model, position, velocity=flow_velocity(position) + uniform)
        largest = still.abs().max().clamp_min(model.flow.scales.acceleration)
        assert (moving - still).abs().max() < 1e-10 * largest


@pytest.mark.mpi(1)
@every_closure
def test_opposite_forces_keep_the_momentum_of_particles_and_forces_of_the_grid_that_of_the_flow(comm, kind):
    """The force of the grid has the mean zero over the box, not over the particles. Kriging among neighbours and the
    relaxation, whose force vanishes with the residual of the solve, are left out."""
    terms = {word: keys for word, keys in CLOSURES[kind].items() if word not in ("filtered-equations", "relaxation")}
    if "pairs" in terms:
        terms["pairs"] = {**terms["pairs"], "basis": "paper", "symmetry": "antisymmetric"}
    if "eddy-viscosity" in terms:
        terms["eddy-viscosity"] = {**terms["eddy-viscosity"], "basis": "paper"}
    for name in ("in 1 % of the box", "empty octant"):
        position = ARRANGEMENTS[name]
        dynamics, particles = set_up(comm, model_of(terms, units()), position)
        context = dynamics.context(particles)
        rates = dynamics.model.rates(context)
        force = rates.acceleration
        if rates.force_modes is not None:
            assert context.resolved.grid.mean(rates.force_modes).norm() < 1e-13 * force.abs().max(), name
            force = force - context.resolved.at_particles(rates.force_modes)
        assert force.sum(0).norm() <= 1e-13 * rates.acceleration.norm(dim=1).sum(), name


@pytest.mark.mpi(2)
def test_particles_may_cross_slabs_and_the_box_within_a_step(comm):
    """At 1000 c, by 0.2, 1.7 and 170 units of length; they change rank before each evaluation."""
    model, position = network_model("own density"), random_points()
    uniform = torch.tensor([0.0, 0.0, FAST], dtype=torch.float64)
    for step in (1e-5, 1e-4, 1e-2):
        still, moving = (advance(*set_up(comm, model, position, velocity), "verlet", step, 2)
                         for velocity in (flow_velocity(position), flow_velocity(position) + uniform))
        still, moving = (by_id(comm, end, end.velocity, len(position)) for end in (still, moving))
        assert (moving - uniform - still).abs().max() < 1e-9


class Breaking(Field):
    """An acceleration that is `value` for one particle of the last rank, at one of its calls."""

    def __init__(self, comm, value, call):
        super().__init__(self.acceleration)
        self.last, self.value, self.calls_left = comm.rank == comm.size - 1, value, call

    def acceleration(self, position, velocity):
        self.calls_left -= 1
        force = torch.zeros_like(velocity)
        if self.last and self.calls_left == 0:
            force[0] = self.value
        return force


@pytest.mark.mpi(2)
@pytest.mark.parametrize("integrator, kind, value", [
    ("verlet", "pressure", math.nan), ("rk4", "pressure", 1e200), ("rk4", "own density", math.nan),
    ("corrected-verlet", "own density", 1e200)])
def test_a_force_that_breaks_within_a_step_is_reported_by_all_ranks(comm, kind, value, integrator):
    """With the second rate a stage of Runge-Kutta 4 breaks, and the end of the others' steps."""
    sound = network_model(kind)
    for call in (1, 2):
        model = LagrangianModel({**sound.terms, "breaking": Breaking(comm, value, call)}, sound.flow)
        complaints = comm.allgather(complaint_after(comm, model, 0.02, 1, integrator)[0])
        assert len(set(complaints)) == 1
        assert re.search(r"rank \d, particle \d+: ", complaints[0])


@pytest.mark.mpi(1)
def test_a_density_from_the_pressure_is_the_same_at_any_mach_number(comm):
    ends = [complaint_after(comm, network_model("pressure", mach), 0.02, 5) for mach in (0.01, 0.3, 0.8)]
    assert all(complaint is None for complaint, _ in ends)
    assert all(torch.allclose(velocity, ends[0][1], atol=1e-9) for _, velocity in ends)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("mach", [0.01, 0.8])
def test_a_learned_density_needs_steps_that_resolve_sound(comm, mach):
    complaint, velocity = complaint_after(comm, network_model("own density", mach), 0.05 * mach, 20)
    assert complaint is None and velocity.abs().max() < 4
    complaint, _ = complaint_after(comm, network_model("own density", mach), 20 * mach, 20)
    assert re.search(r"rank 0, particle \d+: ", complaint)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", ["resolved + pairs", "own density", "paper"])
def test_a_density_contrast_of_a_thousand_leaves_forces_bounded(comm, kind):
    """Sums of weights bound the output of saturated tanh layers."""
    model, position = network_model(kind), random_points()
    density = torch.where(position[:, 0] > math.pi, 1000.0, 1.0).double()
    largest = acceleration(comm, model, position, density=density).abs().max()
    assert largest < 50 * model.flow.scales.acceleration


@pytest.mark.mpi(1)
@every_closure
def test_single_precision_follows_double_precision(comm, kind):
    position, ends = random_points(), []
    for dtype in (torch.float32, torch.float64):
        end = advance(*set_up(comm, network_model(kind), position, dtype=dtype), "verlet", 0.01, 8)
        ends.append(by_id(comm, end, end.velocity, len(position)))
    error = float((ends[0] - ends[1]).norm() / (ends[1] - flow_velocity(position)).norm())
    # A few times the round-off of single precision, 6e-8; more where there are transforms and solves.
    assert 1e-9 < error < (3e-5 if has_grid(kind) or kind == "local" else 1e-6)


@pytest.mark.mpi(2)
def test_an_injection_gives_its_power_as_far_as_the_filter_passes_it(comm):
    """Without another force, in the flow of wavenumber 1, whose energy where the particles are differs from the mean:
    particles meet, and then have more energy than a field of theirs."""
    position, rate = random_points(343), 10.0
    share = flow_velocity(position).square().mean() / flow_velocity(random_points(100_000)).square().mean()
    slab, particles = distributed(comm, position, flow_velocity(position), planes=PLANES)
    model = model_of(injection=dict(injection_rate=rate))
    end = advance(ParticleDynamics(slab, model, SKIN), particles, "rk4", 0.02, 4)
    energies = [0.5 * float(by_id(comm, state, state.velocity, len(position)).square().sum(1).mean())
                for state in (particles, end)]
    passed = math.exp(-model.flow.scales.filter_width**2 / 12)
    assert energies[1] - energies[0] == pytest.approx(float(share) * passed * rate * 0.08, rel=0.03)


# ---- sums over few and many neighbours, and steps

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
