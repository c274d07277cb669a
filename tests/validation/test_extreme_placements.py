"""The particles where they are stiff or extreme, and what is said of a run that must fail."""

import math
import re

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.parallel.broadcast import first_complaint
from eddies.parallel.halo import HaloError
from eddies.parallel.reduction import any_rank, global_max
from eddies.particles import moments
from eddies.particles.context import REGULARISATION
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.faults import Limits, find_fault
from eddies.particles.flow_units import FlowUnits
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.reference_scales import ReferenceScales
from eddies.particles.terms.presets import PRESETS
from tests.particles.clouds import LENGTH, Field, by_id, distributed, of_terms
from tests.particles.clouds import model as model_of

TOTAL, SIDE, PLANES, SKIN = 343, 7, 12, 0.1  # of the grid 1.75 cells a particle and direction
ITERATIONS = 10
PAPER = {"pairs": dict(basis="paper", hidden=(8, 8)), "density-flux": dict(hidden=(8, 8)),
         "eddy-viscosity": dict(form="two-sided", basis="paper")}
CLOSURES = {
    "pressure for the density": {"pressure": dict(force=False), "pairs": {}},
    "pressure": {"pressure": {}, "pairs": {}},
    "resolved + pairs": PRESETS["resolved + pairs"],
    "resolved": PRESETS["resolved"],
    "pairs without density": {"pairs": dict(inputs=("distance", "speed", "approach"))},
    "learned-density": {**PRESETS["learned-density"], "eddy-viscosity": dict(form="monaghan")},
    "paper": PAPER,
    "wcsph": PRESETS["wcsph"],
}
every_closure = pytest.mark.parametrize("kind", CLOSURES)
every_integrator = pytest.mark.parametrize("integrator", INTEGRATORS)
SEPARATIONS = [0.0, 1e-300, 1e-16, 1e-8]  # of nearly coincident particles, in mean spacings
MACH_NUMBERS = [0.01, 0.1, 0.3, 0.8]
NEIGHBORS = [30, 60, 120, 200]


def scales(total, mach=0.1):
    """Of turbulence with v_rms = 1 and the largest eddies of the box; density fluctuations go with M_t^2."""
    spacing = LENGTH / round(total ** (1 / 3))
    return ReferenceScales(
        filter_width=2 * spacing, spacing=spacing, velocity=1.0, density_mean=1.0, density=0.3 * mach**2,
        acceleration=3.0, density_rate=0.5 * mach**2, sound_speed=math.sqrt(3) / mach,
        viscosity=0.02)


def units(total, neighbors=24.0, mach=0.1):
    """So many neighbours on average."""
    flow = scales(total, mach)
    return FlowUnits(flow, flow.spacing * (neighbors * 3 / (4 * math.pi)) ** (1 / 3), neighbors)


def network_model(kind, total, neighbors=24.0, mach=0.1):
    """A model with initial weights."""
    return model_of(CLOSURES[kind], units(total, neighbors, mach))


def sound_model(total, neighbors=24.0, mach=0.1, relaxation=0.0):
    """Linear gas dynamics: dv/dt = -c^2 grad rho / rho_0, d rho/dt = -rho_0 div v (+ relaxation of the density)."""
    linear = model_of({"pairs": dict(hidden=(1,)), "density-transport": {}}, units(total, neighbors, mach))
    flow, small, network = linear.flow.scales, 1e-3, linear.terms["pairs"].network  # tanh is linear for small arguments
    gain = flow.sound_speed**2 * flow.density / (flow.density_mean * flow.acceleration * flow.filter_width)
    with torch.no_grad():
        network.weights[0][:] = torch.tensor([[-small, small, 0, 0, 0]])
        network.weights[1][:] = torch.tensor([[gain / small], [0]])
        linear.terms["density-transport"].factors[:] = torch.tensor([1.0, relaxation])
    return linear


def flow_velocity(position):
    """The ABC flow, v_rms = 1."""
    x, y, z = position.T
    return torch.stack([torch.sin(z) + torch.cos(y), torch.sin(x) + torch.cos(z), torch.sin(y) + torch.cos(x)], dim=1)


def random_points(total, seed=5):
    return torch.from_numpy(np.random.default_rng(seed).uniform(0, LENGTH, (total, 3)))


def lattice(side):
    return torch.from_numpy(np.argwhere(np.ones((side,) * 3)) * (LENGTH / side))


def set_up(comm, model, position, velocity=None, density=None, dtype=torch.float64, skin=SKIN):
    """Dynamics and this rank's particles; at rest and at the mean density unless given."""
    velocity = flow_velocity(position) if velocity is None else velocity
    density = torch.ones(len(position), dtype=torch.float64) if density is None else density
    slab, particles = distributed(comm, position, velocity, density, planes=PLANES)
    dynamics = ParticleDynamics(slab, model.to(dtype), skin, dtype)
    if dynamics.resolution is not None:
        # So many that different ranks, frames and precisions do the same, and no more of what ill-posed arrangements do
        # to rounding.
        dynamics.resolution.iterations = ITERATIONS
    return dynamics, particles


@torch.no_grad()
def acceleration(comm, model, position, **given):
    """Of all particles by id, on every rank."""
    dynamics, particles = set_up(comm, model, position, **given)
    particles, _ = dynamics.settle(particles)
    return by_id(comm, particles, dynamics.rates(particles).acceleration, len(position))


@torch.no_grad()
def advance(dynamics, particles, integrator, step, count):
    stepper = INTEGRATORS[integrator](dynamics)
    for _ in range(count):
        particles = stepper.step(particles, step)
    return particles


def fault(comm, dynamics, particles, model):
    """The complaint about a state, by the limits that a rollout has."""
    limits = Limits(30 * model.flow.scales.velocity, model.flow.scales.density_mean, 300 * model.flow.scales.density)
    return find_fault(particles, limits, dynamics.box, step=1, rank=comm.rank)


def finite(comm, particles):
    columns = [column for name, column in particles.columns().items() if name != "id"]
    return not any_rank(comm, not all(bool(torch.isfinite(column).all()) for column in columns))


def pairs_at(separation, total):
    """Random points, the first of which lie at the origin, and a twin of each at a separation in mean spacings."""
    single = random_points(total // 2)
    single[0] = 0.0
    shift = torch.tensor([1.0, 0.0, 0.0], dtype=torch.float64) * separation * LENGTH / round(total ** (1 / 3))
    return torch.cat([single, single + shift])


ARRANGEMENTS = {
    "in 1 % of the box": lambda total: random_points(total) * 0.01 ** (1 / 3),
    "in 1 % of the box, across a corner": lambda total: (random_points(total) - math.pi) * 0.01 ** (1 / 3) % LENGTH,
    "empty octant": lambda total: random_points(2 * total)[(random_points(2 * total) > math.pi).any(1)][:total],
    "in a plane": lambda total: random_points(total) * torch.tensor([1.0, 1.0, 0.0]),
    "on a line": lambda total: random_points(total) * torch.tensor([1.0, 0.0, 0.0]),
    "all at one point": lambda total: torch.ones(total, 3, dtype=torch.float64),
}


def nearly_coincident(comm, kind, separation, total=TOTAL):
    """Largest difference of accelerations from those of coincident particles over the largest of them, and whether
    two steps of velocity Verlet stay finite."""
    model, position = network_model(kind, total), pairs_at(separation, total)
    velocity = flow_velocity(pairs_at(0.0, total))
    together = acceleration(comm, model, pairs_at(0.0, total), velocity=velocity)
    apart = acceleration(comm, model, position, velocity=velocity)
    end = advance(*set_up(comm, model, position, velocity), "verlet", 0.01, 2)
    return float((apart - together).abs().max() / together.abs().max()), finite(comm, end)


def arrangement(comm, kind, name, total=TOTAL, count=2):
    """Largest difference of the accelerations from those on one rank, over the largest of them or the typical one; and
    whether steps stay finite."""
    model, position = network_model(kind, total), ARRANGEMENTS[name](total)
    alone, here = (acceleration(group, model, position) for group in (MPI.COMM_SELF, comm))
    end = advance(*set_up(comm, model, position), "rk2", 0.01, count)
    largest = alone.abs().max().clamp_min(model.flow.scales.acceleration)
    return float((here - alone).abs().max() / largest), finite(comm, end)


def few_particles(comm, kind, integrator, total):
    """Largest distance from straight lines of particles too far apart to see each other, after three steps."""
    position = torch.full((total, 3), 1.0, dtype=torch.float64)
    position[:, 2] = (torch.arange(total) + 0.25) * LENGTH / total
    model = network_model(kind, TOTAL)
    dynamics, particles = set_up(comm, model, position)
    end = advance(dynamics, particles, integrator, 0.02, 3)
    found = by_id(comm, end, end.position, total)
    straight = position + 0.06 * flow_velocity(position)
    return float(dynamics.box.displacement(found, straight).abs().max())


def pushed_by_the_grid(kind):
    """Whether the model has a force from its grid."""
    return "resolved" in network_model(kind, TOTAL).reads and kind != "pressure for the density"


def lattice_at_rest(comm, kind, dtype=torch.float64, side=SIDE, count=5):
    """Largest speed after `count` steps, over what a step of the typical acceleration gives."""
    model, position = network_model(kind, side**3), lattice(side)
    dynamics, particles = set_up(comm, model, position, torch.zeros_like(position), dtype=dtype)
    end = advance(dynamics, particles, "verlet", 0.02, count)
    speed = global_max(comm, float(end.velocity.abs().max()) if len(end) else 0.0)
    return float(speed) / (0.02 * model.flow.scales.acceleration)


def translation(comm, kind, speed, position):
    """Largest change of the acceleration by a uniform velocity, over the largest acceleration or the typical one."""
    model = network_model(kind, len(position))
    moving = flow_velocity(position) + torch.tensor([0.5, -0.3, 1.0]) * speed
    still, carried = acceleration(comm, model, position), acceleration(comm, model, position, velocity=moving)
    return float((carried - still).abs().max() / still.abs().max().clamp_min(model.flow.scales.acceleration))


def momentum_gained(comm, kind, position):
    """Sum of the accelerations over the sum of their sizes, the pair sum being antisymmetric."""
    terms = dict(CLOSURES[kind])
    if "pairs" in terms:
        terms["pairs"] = {**terms["pairs"], "basis": "paper", "symmetry": "antisymmetric"}
    if "eddy-viscosity" in terms:
        terms["eddy-viscosity"] = {**terms["eddy-viscosity"], "basis": "paper"}
    force = acceleration(comm, model_of(terms, units(TOTAL)), position)
    return float(force.sum(0).norm() / force.norm(dim=1).sum())


def translated_run(comm, kind, speed, step, total=TOTAL):
    """Two steps in a frame that moves at `speed` along z: largest error of velocities, or what is said."""
    model, position = network_model(kind, total), random_points(total)
    uniform = torch.tensor([0.0, 0.0, speed], dtype=torch.float64)
    ends = []
    for velocity in (flow_velocity(position), flow_velocity(position) + uniform):
        dynamics, particles = set_up(comm, model, position, velocity)
        try:
            end = advance(dynamics, particles, "verlet", step, 2)
        except HaloError as told:
            return str(told)
        ends.append(by_id(comm, end, end.velocity, total))
    return float((ends[1] - uniform - ends[0]).abs().max())


def at_mach_number(comm, kind, mach, step, total=TOTAL, count=20):
    """Velocities after so many steps, or the complaint of the first rank that has one."""
    model = network_model(kind, total, mach=mach)
    dynamics, particles = set_up(comm, model, random_points(total))
    try:
        end = advance(dynamics, particles, "rk4", step, count)
    except HaloError as told:
        return str(told), None
    return fault(comm, dynamics, end, model), by_id(comm, end, end.velocity, total)


def density_contrast(comm, kind, contrast, total=TOTAL):
    """Acceleration of particles half of which are denser by a factor, in typical accelerations: its largest."""
    model, position = network_model(kind, total), random_points(total)
    density = torch.where(position[:, 0] > math.pi, contrast, 1.0).double()
    return float(acceleration(comm, model, position, density=density).abs().max()) / model.flow.scales.acceleration


def precision_error(comm, kind, count, total=TOTAL):
    """Relative difference of velocities changed in single and in double precision, after so many steps."""
    position, ends = random_points(total), []
    for dtype in (torch.float32, torch.float64):
        end = advance(*set_up(comm, network_model(kind, total), position, dtype=dtype), "verlet", 0.01, count)
        ends.append(by_id(comm, end, end.velocity, total))
    return float((ends[0] - ends[1]).norm() / (ends[1] - flow_velocity(position)).norm())


def gradient_error(neighbors, total=1728):
    """Relative error of -c^2 grad rho of a linear density where the gradient is seen whole, by random neighbours."""
    model, position = sound_model(total, neighbors), random_points(total)
    slope = torch.tensor([1e-3, -2e-3, 0.5e-3], dtype=torch.float64) * model.flow.scales.density
    rest = torch.zeros_like(position)
    found = acceleration(MPI.COMM_SELF, model, position, velocity=rest, density=1 + (position - math.pi) @ slope)
    inside = ((position > model.flow.cutoff) & (position < LENGTH - model.flow.cutoff)).all(1)
    exact = -model.flow.scales.sound_speed**2 * slope
    return float((found[inside] - exact).norm(dim=1).median() / exact.norm()), int(inside.sum())


def overdriven(comm, rate, count=20, total=TOTAL):
    """Energy gained by forced particles without another force, over the energy injected."""
    position = random_points(total)
    slab, particles = distributed(comm, position, flow_velocity(position), planes=PLANES)
    dynamics = ParticleDynamics(slab, model_of(forcing=dict(injection_rate=rate)), SKIN)
    end = advance(dynamics, particles, "rk4", 0.02, count)
    energies = [0.5 * float(by_id(comm, state, state.velocity, total).square().sum(1).mean())
                for state in (particles, end)]
    return (energies[1] - energies[0]) / (rate * 0.02 * count)


# Steps of known stiffness. A step multiplies a wave or a mode by `amplification` of z = step times its rate.


def spring(frequency=0.0, drag=0.0):
    """Acceleration -frequency^2 x from the middle of the box, or -rate v."""
    return of_terms(Field(lambda position, velocity: -frequency**2 * (position - math.pi) - drag * velocity))


def amplification(integrator, system, z):
    """Spectral radius of one step: "oscillator" x'' = -x, "drag" v' = -v, "sound" y' = iy, at the step z."""
    if integrator.startswith("rk"):
        z = -z if system == "drag" else 1j * z
        return abs(sum(z**n / math.factorial(n) for n in range(int(integrator[2:]) + 1)))
    if system == "oscillator":  # positions and forces leapfrog
        return max(abs(np.linalg.eigvals([[1 - z**2 / 2, z], [-z + z**3 / 4, 1 - z**2 / 2]])))
    # The rate at the velocity (or density) predicted by Euler's rule, averaged with the last one so obtained: that is
    # the second-order rule of Adams and Bashforth for the predictions.
    z = -z if system == "drag" else 1j * z
    return max(abs(np.roots([1, -(1 + 1.5 * z), 0.5 * z])))


def boundary(integrator, system, growth):
    """The smallest step z at which a mode grows by more than `growth` a step."""
    steps = np.linspace(0, 4, 40_001)[1:]
    return float(steps[np.argmax([amplification(integrator, system, z) > 1 + growth for z in steps])])


def oscillator_growth(integrator, system, z, count=32):
    """Growth a step of one particle on a spring, or braked, from the last two quarters of the steps."""
    force = spring(frequency=1.0) if system == "oscillator" else spring(drag=1.0)
    position, velocity = torch.full((1, 3), math.pi, dtype=torch.float64), torch.full((1, 3), 1e-9).double()
    slab, particles = distributed(MPI.COMM_SELF, position, velocity, planes=PLANES)
    stepper, sizes = INTEGRATORS[integrator](ParticleDynamics(slab, force, SKIN)), []
    for _ in range(count):
        particles = stepper.step(particles, z)
        away = float(particles.position[0, 0] - position[0, 0]) if system == "oscillator" else 0.0
        sizes.append(math.hypot(away, float(particles.velocity[0, 0])))
    quarter = count // 4
    return (max(sizes[-quarter:]) / max(sizes[-2 * quarter : -quarter])) ** (1 / quarter)


def sound_frequency(model, side, waves):
    """Frequency of a wave along x on a lattice by the sums over its neighbours, c sum w x sin(kx) / sum w x^2."""
    reach = math.ceil(model.flow.cutoff / (LENGTH / side))
    offsets = np.argwhere(np.ones((2 * reach + 1,) * 3)) - reach
    x = offsets[np.any(offsets, axis=1)] * LENGTH / side
    weight = np.clip(1 - np.sum(x**2, axis=1) / model.flow.cutoff**2, 0, None) ** 2
    kept = REGULARISATION * moments.expected_moment(model.flow.neighbors, model.flow.cutoff)
    slope = np.sum(weight * x[:, 0] * np.sin(waves * x[:, 0])) / (np.sum(weight * x[:, 0] ** 2) + kept)
    return model.flow.scales.sound_speed * slope


@torch.no_grad()
def sound_growth(integrator, z, count=20, side=8, waves=2):
    """Growth a step of a standing sound wave of the learned-density closure on a lattice; z: step times frequency."""
    model, position = sound_model(side**3), lattice(side)
    density = 1 + 1e-6 * model.flow.scales.density * torch.cos(waves * position[:, 0])
    dynamics, particles = set_up(MPI.COMM_SELF, model, position, torch.zeros_like(position), density)
    stepper, sizes = INTEGRATORS[integrator](dynamics), []
    for _ in range(count):
        particles = stepper.step(particles, z / sound_frequency(model, side, waves))
        # Other waves grow out of round-off: this one alone is measured.
        phase = waves * particles.position[:, 0]
        sizes.append(math.hypot(float((particles.density - 1) @ torch.cos(phase)) * model.flow.scales.sound_speed,
                                float(particles.velocity[:, 0] @ torch.sin(phase))))
    return (sizes[-1] / sizes[count // 2]) ** (1 / (count - 1 - count // 2))


SYSTEMS = {
    "oscillator": lambda integrator, z: oscillator_growth(integrator, "oscillator", z),
    "drag": lambda integrator, z: oscillator_growth(integrator, "drag", z),
    "sound": sound_growth,
}


def measured_boundary(integrator, system, growth, low=0.02, high=4.0):
    """The smallest step at which the mode grows by more than `growth` a step, by bisection to a thousandth."""
    while high - low > 1e-3 * high:
        middle = (low + high) / 2
        low, high = (low, middle) if SYSTEMS[system](integrator, middle) > 1 + growth else (middle, high)
    return (low + high) / 2


@pytest.mark.mpi(1)
@every_closure
def test_nearly_coincident_particles_move_as_coincident_ones(comm, kind):
    for separation in SEPARATIONS:
        difference, sound = nearly_coincident(comm, kind, separation)
        # Accelerations vary over the cutoff, here two spacings, by a few times themselves; where the few neighbours
        # are nearly in a plane, by a hundred times.
        assert sound and difference <= 300 * separation + 1e-12


@pytest.mark.mpi(2)
@pytest.mark.parametrize("name", ARRANGEMENTS)
@pytest.mark.parametrize("kind", ["resolved + pairs", "learned-density"])
def test_any_arrangement_has_finite_rates_that_are_the_same_on_all_ranks(comm, kind, name):
    difference, sound = arrangement(comm, kind, name)
    assert sound and difference < 1e-9


@pytest.mark.mpi(2)
@pytest.mark.parametrize("total", [1, 2])
@every_integrator
def test_few_particles_move_straight_on(comm, integrator, total):
    """One a rank, and none on a rank. But two push each other by the pressure on a grid, from any distance."""
    for kind in CLOSURES:
        if total == 1 or not pushed_by_the_grid(kind):
            assert few_particles(comm, kind, integrator, total) < 1e-12


@pytest.mark.mpi(1)
@every_closure
def test_a_lattice_at_rest_stays_at_rest(comm, kind):
    assert lattice_at_rest(comm, kind) < 1e-13
    # The pressures of WCSPH are c^2, a hundred times the accelerations, and cancel.
    assert lattice_at_rest(comm, kind, torch.float32) < (1e-3 if kind == "wcsph" else 1e-5)


@pytest.mark.mpi(1)
@every_closure
def test_a_uniform_velocity_of_a_thousand_times_sound_changes_no_force(comm, kind):
    """Wherever particles are. 1000 c is 1.7e4 v_rms: its round-off is 2e-12, which differences of velocities keep."""
    speed = 1000 * scales(TOTAL).sound_speed
    assert translation(comm, kind, speed, random_points(TOTAL)) < 1e-10
    for name in ARRANGEMENTS if "resolved" in network_model(kind, TOTAL).reads else ():
        assert translation(comm, kind, speed, ARRANGEMENTS[name](TOTAL)) < 1e-10, name


@pytest.mark.mpi(1)
@every_closure
def test_opposite_forces_keep_the_momentum_with_every_model(comm, kind):
    for name in ("in 1 % of the box", "empty octant"):
        assert momentum_gained(comm, kind, ARRANGEMENTS[name](TOTAL)) < 1e-13, name


@pytest.mark.mpi(1, 2)
def test_particles_may_cross_slabs_and_the_box_within_a_step(comm):
    """At 1000 c, by 0.2, 1.7 and 170; they change rank before each evaluation."""
    speed = 1000 * scales(TOTAL).sound_speed
    for step in (1e-5, 1e-4, 1e-2):
        assert translated_run(comm, "learned-density", speed, step) < 1e-9


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


def broken_step(comm, kind, integrator, value, call, total=TOTAL):
    """What is said, on every rank, of a step in which a force breaks."""
    sound = network_model(kind, total)
    model = LagrangianModel({**sound.terms, "breaking": Breaking(comm, value, call)}, sound.flow)
    dynamics, particles = set_up(comm, model, random_points(total))
    try:
        end = advance(dynamics, particles, integrator, 0.02, 1)
    except HaloError as told:
        return comm.allgather(str(told))
    return comm.allgather(first_complaint(comm, fault(comm, dynamics, end, model)))


@pytest.mark.mpi(2)
@pytest.mark.parametrize("kind", ["pressure", "learned-density"])
@every_integrator
def test_a_force_that_breaks_within_a_step_is_reported_by_all_ranks(comm, kind, integrator):
    """With the second rate a stage of Runge-Kutta 4 breaks, and the end of the others' steps."""
    for value in (math.nan, 1e200):
        for call in (1, 2):
            told = broken_step(comm, kind, integrator, value, call)
            assert len(set(told)) == 1
            assert re.search(r"rank \d, particle \d+: (not finite|faster|density|farther outside its slab)", told[0])


@pytest.mark.mpi(1)
def test_a_density_from_the_pressure_is_the_same_at_any_mach_number(comm):
    ends = [at_mach_number(comm, "pressure for the density", mach, 0.02, count=5) for mach in MACH_NUMBERS]
    assert all(complaint is None for complaint, _ in ends)
    assert all(torch.allclose(velocity, ends[0][1], atol=1e-9) for _, velocity in ends)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("mach", MACH_NUMBERS)
def test_a_learned_density_needs_steps_that_resolve_sound(comm, mach):
    complaint, velocity = at_mach_number(comm, "learned-density", mach, 0.1 * mach)
    assert complaint is None and velocity.abs().max() < 4
    complaint, _ = at_mach_number(comm, "learned-density", mach, 20 * mach)
    assert re.search(r"rank 0, particle \d+: (not finite|faster than|density farther)", complaint)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", [kind for kind, terms in CLOSURES.items() if "pairs" in terms])
def test_a_density_contrast_of_a_thousand_leaves_forces_bounded(comm, kind):
    """The outputs of saturated tanh layers are bounded by sums of weights."""
    assert density_contrast(comm, kind, 1000.0) < 50


@pytest.mark.mpi(1)
@every_closure
def test_single_precision_follows_double_precision(comm, kind):
    # Round-off of single precision, 6e-8, a few times.
    # What is made on the grid is in double precision whatever that of the particles is.
    least = 1e-9 if "pairs" in network_model(kind, TOTAL).reads else 1e-11
    assert least < precision_error(comm, kind, 8) < 1e-6


@pytest.mark.mpi(1)
@pytest.mark.parametrize("neighbors", NEIGHBORS)
def test_moments_correct_differences_among_30_to_200_neighbours(comm, neighbors):
    error, points = gradient_error(neighbors)
    assert points > 0 and error < 2 * REGULARISATION


@pytest.mark.mpi(1, 2)
def test_an_injection_ten_times_too_strong_injects_ten_times_as_much(comm):
    assert overdriven(comm, 1.0) == pytest.approx(1, abs=1e-3)
    assert overdriven(comm, 10.0) == pytest.approx(1, abs=1e-3)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("system", SYSTEMS)
@every_integrator
def test_a_step_beyond_the_stability_boundary_grows_as_theory_says(comm, integrator, system):
    limit = boundary(integrator, system, 0.01)
    assert SYSTEMS[system](integrator, 0.97 * limit) < 1.01 < SYSTEMS[system](integrator, 1.03 * limit)
    if system != "oscillator":
        grown = SYSTEMS[system](integrator, 1.1 * limit)
        assert grown == pytest.approx(amplification(integrator, system, 1.1 * limit), rel=1e-4)
