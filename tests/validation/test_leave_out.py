"""A scene pays only for what it has: calls, transforms and messages are counted."""

from contextlib import contextmanager

import pytest
import torch
from flows import turbulence

from eddies.flow.navier_stokes import IncompressibleFluid
from eddies.learning import force_training
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.training import Adam
from eddies.particles.context import Context
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import WendlandC2
from eddies.particles.terms.eddy_viscosity import EddyViscosity
from eddies.scene.terms import PRESETS
from tests.parallel.counting import CountingComm
from tests.particles.configurations import LENGTH, OWN_DENSITY, distributed, lattice, model

PER_SIDE, STEP = 9, 0.001
SPACING = LENGTH / PER_SIDE
SCALES = ReferenceScales(filter_width=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0, density=0.01,
                         acceleration=1.0, density_rate=0.02, sound_speed=10.0, viscosity=0.01)
FORCING = {"injection": dict(injection_rate=0.5)}
NO_DENSITY = {"pairs": dict(inputs=("distance", "speed", "approach"))}
# The same forces without pairs, with pairs, and with pairs that read the densities of the pressure.
BESIDE_THE_RESOLVED = {"resolved": PRESETS["resolved"], "resolved + pairs": PRESETS["resolved + pairs"],
                       "with densities": {**PRESETS["resolved"], "pairs": {}}}


@contextmanager
def counted(*methods):
    """Counts calls of (owner, name) pairs: yields the list of the names called."""
    calls = []

    def counting(name, original):
        return lambda *arguments, **named: calls.append(name) or original(*arguments, **named)

    with pytest.MonkeyPatch.context() as patch:
        for owner, name in methods:
            patch.setattr(owner, name, counting(name, getattr(owner, name)))
        yield calls


def set_up(comm, terms, density=True):
    """Dynamics of these terms, and particles on a lattice."""
    position = lattice(PER_SIDE)
    columns = [position, torch.sin(position[:, [1, 2, 0]]), *([torch.ones_like(position[:, 0])] if density else ())]
    slab, particles = distributed(comm, *columns, planes=PER_SIDE)
    lagrangian = model(terms, FlowUnits(SCALES, 1.5 * SPACING, 14.0))
    return ParticleDynamics(slab, lagrangian, SPACING), particles


def particle_step(comm, terms, density=True):
    """A function that takes a step of velocity Verlet, with halo and list built; it evaluates the rates once."""
    dynamics, particles = set_up(comm, terms, density)
    stepper = INTEGRATORS["verlet"](dynamics)
    with torch.no_grad():
        state = [stepper.step(particles, STEP)]

    @torch.no_grad()
    def step():
        state[0] = stepper.step(state[0], STEP)
        return state[0]

    return step


def messages_of(comm, terms, density=True):
    counting = CountingComm(comm)
    step = particle_step(counting, terms, density)
    counting.sent.clear()
    step()
    return counting.sent


def combined_step(comm, **weights):
    """A function that takes a training step on the losses with these weights, and the list of its messages."""
    counting = CountingComm(comm)
    dynamics, particles = set_up(counting, OWN_DENSITY)
    truth = torch.cos(particles.position)
    frame = TrainingFrame(dynamics, particles, truth, truth[:, 0])
    learner = ForceTrainer(dynamics.model, [frame], WendlandC2(1.7 * SPACING), LossWeights(**weights), 100, seed=5)
    optimizer = Adam(counting, learner.model.parameters(), 9, 1e-2, 1e-3)
    learner.combined_step(optimizer, 0)
    counting.sent.clear()
    return lambda: learner.combined_step(optimizer, 1), counting.sent


def losses_called(comm, **weights):
    """The calls and the messages of a step with these losses."""
    step, sent = combined_step(comm, **weights)
    with counted((force_training, "reconstruct"), (force_training, "soft_histogram"),
                 (force_training, "NeighborList")) as calls:
        step()
    return calls, sent


def fluid_of(comm, compressible, forced):
    """Fluid and state."""
    fluid, state = turbulence(comm, 12, rate=0.5 if forced else None)
    if compressible:
        return fluid, state
    return IncompressibleFluid(fluid.grid, fluid.viscosity, forcing=fluid.forcing), state[:3]


@pytest.mark.mpi(1)
def test_one_rank_sends_nothing(comm):
    for terms in PRESETS.values():
        assert messages_of(comm, {**terms, **FORCING}) == []
    assert losses_called(comm, field=1.0, velocity_kl=0.1, acceleration_kl=0.1)[1] == []


@pytest.mark.mpi(2)
def test_a_force_pays_with_messages_for_what_it_has_alone(comm):
    assert messages_of(comm, {}) == []
    # Votes on the list before the step and at its end; then position, velocity, density: up and down.
    assert sorted(messages_of(comm, OWN_DENSITY)) == ["Allreduce"] * 2 + ["Sendrecv"] * 6
    # Without a term that reads the density none is sent.
    assert sorted(messages_of(comm, NO_DENSITY, density=False)) == ["Allreduce"] * 2 + ["Sendrecv"] * 4


@pytest.mark.mpi(2)
def test_a_model_pays_with_transposes_for_the_terms_that_it_has_alone(comm):
    # The resolved velocity takes a solve, which starts so close that it ends at once: the residual at the particles
    # and back, 2; then the products, from which its rate of change follows, 2.
    resolved = 2 + 2
    # The products of the velocity with the filter undone: to the grid and back, 2. The modes of all terms together go
    # to the particles once.
    expected = {("pairs",): 0, ("pressure",): resolved + 1, ("stress",): resolved + 2 + 1, ("damping",): resolved + 1,
                ("relaxation",): resolved, ("injection",): resolved + 1,
                ("pressure", "stress", "damping", "relaxation", "pairs"): resolved + 2 + 1}
    settings = {**PRESETS["resolved + pairs"], **FORCING}
    for words, transposes in expected.items():
        sent = messages_of(comm, {word: settings.get(word, {}) for word in words})
        assert sent.count("Alltoallv") == transposes, words


@pytest.mark.mpi(1)
def test_a_density_that_no_term_reads_is_neither_computed_nor_kept(comm):
    for terms in (PRESETS["resolved"], NO_DENSITY, {}):
        dynamics, particles = set_up(comm, terms, density=False)
        with torch.no_grad():
            rates = dynamics.rates(particles)
            ends = [integrator(dynamics).step(particles, STEP) for integrator in INTEGRATORS.values()]
        assert rates.density is None and rates.density_rate is None
        assert all(end.density is None and "density" not in end.columns() for end in ends)


@pytest.mark.mpi(1)
def test_the_pressure_goes_to_the_particles_only_where_a_term_reads_the_density(comm, monkeypatch):
    values, at = [], FourierGrid.at
    monkeypatch.setattr(FourierGrid, "at", lambda grid, modes, x: values.append(len(modes)) or at(grid, modes, x))
    for terms in BESIDE_THE_RESOLVED.values():
        dynamics, particles = set_up(comm, terms)
        dynamics.resolution.iterations = 1
        with torch.no_grad():
            dynamics.rates(particles)
    # The residual at the start, an iteration, and the force; with it p.
    assert values == 2 * [3, 3, 3] + [3, 3, 4]


@pytest.mark.mpi(2)
@pytest.mark.parametrize("word, parameter", [("damping", "rates"), ("relaxation", "factor"),
                                             ("injection", None), ("eddy-viscosity", "coefficients")])
def test_a_term_of_zero_amplitude_gives_the_numbers_of_the_model_without_it(comm, word, parameter):
    others = {"pressure": {}, "pairs": {}}
    without, particles = set_up(comm, others)
    given = dict(injection_rate=0.0) if word == "injection" else {}
    with_it, _ = set_up(comm, {**others, word: given})
    with torch.no_grad():
        if parameter is not None:
            getattr(with_it.model.terms[word], parameter).zero_()
        expected, found = without.rates(particles), with_it.rates(particles)
    # Sums over pairs agree to the last bit; a force on the grid is interpolated with another zero added.
    assert torch.allclose(found.acceleration, expected.acceleration, rtol=0, atol=1e-14)
    assert torch.allclose(found.density, expected.density, rtol=0, atol=1e-15)


@pytest.mark.mpi(1)
def test_a_term_that_is_not_there_is_not_evaluated(comm):
    found = []
    for terms in ({"pairs": {}}, {"pairs": {}, "eddy-viscosity": {}}):
        step = particle_step(comm, terms)
        with counted((EddyViscosity, "rates_of"), (ResolvedVelocity, "of"), (Context, "without_mean")) as calls:
            step()
        found.append(set(calls))
    assert found == [set(), {"rates_of"}]


@pytest.mark.mpi(2)
def test_a_loss_without_weight_is_not_evaluated(comm):
    everything, sent = losses_called(comm, field=1.0, velocity_kl=0.1, acceleration_kl=0.1)
    assert sorted(everything) == ["NeighborList", "reconstruct"] + ["soft_histogram"] * 4
    nothing, fewest = losses_called(comm)
    assert nothing == [] and len(fewest) < len(sent)
    assert sorted(losses_called(comm, field=1.0)[0]) == ["NeighborList", "reconstruct"]
    assert losses_called(comm, velocity_kl=0.1)[0] == ["soft_histogram"] * 2
    assert losses_called(comm, acceleration_kl=0.1)[0] == ["soft_histogram"] * 2


@pytest.mark.mpi(2)
def test_a_flow_pays_for_neither_density_nor_forcing_that_it_does_not_have(comm):
    sent, carried = {}, {}
    for compressible, forced in ((False, False), (False, True), (True, False), (True, True)):
        counting = CountingComm(comm)
        fluid, state = fluid_of(counting, compressible, forced)
        counting.sent.clear()
        counting.bytes = 0
        fluid.nonlinear(state)
        sent[compressible, forced], carried[compressible, forced] = counting.sent, counting.bytes
    for compressible in (False, True):
        assert "Allreduce" not in sent[compressible, False] and "Allreduce" in sent[compressible, True]
        assert carried[compressible, False] == carried[compressible, True]
    assert carried[False, False] < carried[True, False]
