"""Configurations of particles, models and helpers for the tests of particles."""

import math

import numpy as np
import torch
from mpi4py import MPI

from eddies.parallel.migration import migrate
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.model import FORCING, LagrangianModel, build_model
from eddies.particles.neighborhood import NeighborList
from eddies.particles.pairs import ScaledPairs
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.rates import Rates
from eddies.particles.terms.term import Term
from eddies.scene.terms import PRESETS, TERMS, Forcing, NetworkSettings, TermSettings

LENGTH = 2 * math.pi
SCALES = ReferenceScales(filter_width=1.2, spacing=0.6, velocity=0.9, density_mean=1.0, density=0.02, acceleration=1.7,
                         density_rate=0.05, sound_speed=11.0, viscosity=0.03)
CUTOFF, NEIGHBORS = 1.5, 12.0
FLOW = FlowUnits(SCALES, CUTOFF, NEIGHBORS)
CONFIGURATIONS = {
    "even": lambda random, n: random.uniform(0, LENGTH, (n, 3)),
    "cluster across a corner": lambda random, n: random.normal(0, 0.4, (n, 3)) % LENGTH,
    "void": lambda random, n: random.uniform(0, LENGTH, (n, 3)) * [1, 1, 0.3],
    "uneven": lambda random, n: LENGTH * random.uniform(0, 1, (n, 3)) ** 4,
    "lattice": lambda random, n: np.argwhere(np.ones((8, 8, n // 64))) * (LENGTH / 8),
    "coincident": lambda random, n: np.full((n, 3), 6.28),
}
#: A model that reads and integrates a density.
OWN_DENSITY = {"pairs": {}, "density-flux": {}, "continuity": dict(diffusion=0.1)}
OPEN = dict(window="none", scaling="root")
#: Models of pairs.
PAIR_MODELS = {
    "paper": {"pairs": dict(basis="paper"), "density-flux": {},
              "eddy-viscosity": dict(form="two-sided", basis="paper")},
    "published": {"pairs": dict(basis="unit", **OPEN), "eddy-viscosity": dict(basis="unit", form="bounded", **OPEN),
                  "density-flux": dict(sign=True, **OPEN), "density-diffusion": OPEN},
    "corrected": {**OWN_DENSITY, "eddy-viscosity": dict(form="monaghan")},
    "pairs": {"pairs": {}},
    "antisymmetric": {"pairs": dict(basis="paper", symmetry="antisymmetric"), "continuity": {},
                      "eddy-viscosity": dict(form="monaghan", basis="paper")},
    "without density": {"pairs": dict(inputs=("distance", "speed", "approach"))},
    "sph": {**PRESETS["transport-velocity"], "continuity": dict(diffusion=0.1)},
}
#: Models with a resolved velocity.
RESOLVED_MODELS = {
    "pressure": {"pressure": {}, "pairs": {}},
    "pairs with density": {**PRESETS["resolved"], "pairs": {}},
    **{name: PRESETS[name] for name in ("resolved + pairs", "resolved")},
}
MODELS = PAIR_MODELS | RESOLVED_MODELS


def positions(kind="even", count=200, seed=3):
    """Positions (count, 3) of a configuration."""
    return torch.as_tensor(CONFIGURATIONS[kind](np.random.default_rng(seed), count) % LENGTH)


def state(count=200, seed=3, kind="even"):
    """Position, velocity and density of the particles of a configuration."""
    random = np.random.default_rng(seed + 1)
    velocity = torch.as_tensor(random.normal(0, SCALES.velocity, (count, 3)))
    density = torch.as_tensor(random.normal(1, SCALES.density, count))
    return positions(kind, count, seed), velocity, density


def lattice(side, disorder=0.0):
    """Positions (side^3, 3) at the centres of cells, each moved by up to `disorder` cells along the axes."""
    moved = np.random.default_rng(4).uniform(-disorder, disorder, (side**3, 3))
    return torch.as_tensor((np.argwhere(np.ones((side,) * 3)) + 0.5 + moved) * (LENGTH / side))


def model(terms=None, flow=FLOW, **more):
    """Model of terms by their words, each with its settings, with small networks in double precision.

    Keywords have "_" for "-". "injection" is the forcing of rollouts.
    """
    given = {**(terms or {}), **{word.replace("_", "-"): settings for word, settings in more.items()}}
    forcing = Forcing(**given.pop(FORCING)) if FORCING in given else None
    settings = {word: _settings(TERMS[word], chosen) for word, chosen in given.items()}
    return build_model(settings, settings, flow).forced(forcing)


def _settings(kind, chosen):
    small = {"hidden": (6, 5)} if issubclass(kind, NetworkSettings) else {}
    return kind(**{**small, **chosen})


def declared(reads=(), gives=("acceleration",)):
    """Settings of a term with these inputs and contributions."""
    return type("Settings", (TermSettings,), {"reads": reads, "gives": gives})()


class Given(Term):
    """A term whose rates are a function of the context."""

    def __init__(self, function, reads=(), gives=("acceleration",)):
        super().__init__(declared(reads, gives), FLOW)
        self.function = function

    def forward(self, context):
        return self.function(context)


class Field(Given):
    """A term whose acceleration is a function of position and velocity."""

    def __init__(self, acceleration):
        super().__init__(lambda context: Rates(acceleration(context.particles.position, context.particles.velocity)))


def density_reader():
    """A term that reads the density and contributes nothing."""
    return Given(lambda context: Rates(), reads=("density",))


def of_terms(*terms, flow=FLOW):
    """Model of term objects."""
    return LagrangianModel({f"{type(term).__name__} {number}": term for number, term in enumerate(terms)}, flow)


def dynamics_of(slab, lagrangian, skin=0.2, iterations=None, tolerance=None, **options):
    """Dynamics with a number of iterations, or a final residual, of the solves for the resolved velocity."""
    dynamics = ParticleDynamics(slab, lagrangian, skin, **options)
    if dynamics.resolution is not None:
        resolution = dynamics.resolution
        resolution.iterations = iterations
        if tolerance is not None:
            resolution.tolerance = resolution.tolerance_predicted = resolution.tolerance_adjoint = tolerance
    return dynamics


def rates(lagrangian, position, velocity, density=None, skin=0.3, dtype=None, planes=13):
    """Rates of all particles of a periodic box on one rank, in their order."""
    slab = SlabDecomposition(MPI.COMM_SELF, LENGTH, planes)
    particles = ParticleSet(torch.arange(len(position)), position, velocity, density)
    return dynamics_of(slab, lagrangian, skin, dtype=dtype).rates(particles)


def given(rates):
    """The rates by particle that a model gives, by name."""
    return {name: rate for name, rate in vars(rates).items() if rate is not None and not name.endswith("modes")}


def scaled_pairs(position, velocity, density=None, flow=FLOW):
    """All pairs of particles of a periodic box on one rank."""
    listed = NeighborList(PeriodicBox(LENGTH), flow.cutoff, 0.0)
    listed.build(position, position, exclude_self=True)
    columns = {"velocity": velocity, "density": density}
    return ScaledPairs(listed.pairs(position, position), columns.__getitem__, flow)


def summed_density(position, kernel, mass):
    """sum_j m W(x_i - x_j) over all particles of a periodic box, i included."""
    apart = position[:, None] - position
    apart = apart - LENGTH * torch.round(apart.detach() / LENGTH)
    square = apart.square().sum(2)
    itself = torch.eye(len(position), dtype=torch.bool)
    distance = torch.where(itself, torch.ones_like(square), square).sqrt()  # its derivative is then finite
    values = torch.where(itself, kernel.value(torch.zeros_like(square)), kernel.value(distance))
    return mass * values.sum(1)


def by_torch(monkeypatch):
    """Take sums over pairs by the torch expressions of the terms instead of the compiled library."""
    monkeypatch.setattr("eddies.particles.context.kernels_serve", lambda device: False)


def distributed(comm, position, velocity, density=None, planes=13):
    """The slabs, and this rank's part of the given particles."""
    slab = SlabDecomposition(comm, LENGTH, planes)
    own = np.arange(len(position)) % comm.size == comm.rank
    columns = {"id": np.arange(len(position)), "position": position.numpy(), "velocity": velocity.numpy()}
    if density is not None:
        columns["density"] = density.numpy()
    columns = {name: column[own] for name, column in columns.items()}
    return slab, ParticleSet.from_numpy(migrate(slab, columns))


def alone(position, velocity, density=None, planes=13):
    """The same particles, all on one rank."""
    return distributed(MPI.COMM_SELF, position, velocity, density, planes)


def by_id(comm, particles, column, total):
    """Column of all particles in the order of their ids, on every rank."""
    whole = np.zeros((total, *column.shape[1:]))
    whole[particles.id.numpy()] = column.detach().numpy()
    return torch.from_numpy(global_sum(comm, whole))


def assert_close(actual, expected, relative=1e-12):
    assert (actual - expected).abs().max() <= relative * expected.abs().max()


def along(function, inputs, direction, step):
    """Central difference of function(*inputs) along a direction."""
    with torch.no_grad():
        ends = [function(*(x + sign * step * d for x, d in zip(inputs, direction))) for sign in (1, -1)]
    return (ends[0] - ends[1]) / (2 * step)


def relative(values, exact):
    """Relative L2 error."""
    return float(np.linalg.norm(values - exact) / np.linalg.norm(exact))
