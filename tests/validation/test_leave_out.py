"""A scene pays for nothing that it does not have: calls, transforms and messages, counted."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch

from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.learning import force_training
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.optimization import Adam
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.context import Context
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.flow_units import FlowUnits, ReferenceScales
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.neighborhood import Neighborhood
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import WendlandC2
from eddies.particles.terms.eddy_viscosity import EddyViscosity
from eddies.scene.terms import PRESETS
from eddies.spectral.spectral_grid import SpectralGrid
from tests.particles.configurations import OWN_DENSITY, model

LENGTH, PER_SIDE, STEP = 2 * np.pi, 9, 0.001
SPACING = LENGTH / PER_SIDE
SCALES = ReferenceScales(filter_width=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0, density=0.01,
                         acceleration=1.0, density_rate=0.02, sound_speed=10.0, viscosity=0.01)
FORCING = {"injection": dict(injection_rate=0.5)}
NO_DENSITY = {"pairs": dict(inputs=("distance", "speed", "approach"))}
# The same forces without pairs, with pairs, and with pairs that are told the densities of the pressure.
BESIDE_THE_RESOLVED = {"resolved": PRESETS["resolved"], "resolved + pairs": PRESETS["resolved + pairs"],
                       "told densities": {**PRESETS["resolved"], "pairs": {}}}


class CountingComm:
    """A communicator that counts what is sent through it by name, and the bytes of transposes."""

    def __init__(self, comm):
        self.rank, self.size, self._comm, self.sent, self.bytes = comm.rank, comm.size, comm, [], 0

    def __getattr__(self, name):
        method = getattr(self._comm, name)

        def counted(*arguments, **named):
            self.sent.append(name)
            if name == "Alltoallv":
                self.bytes += arguments[0][0].nbytes
            return method(*arguments, **named)

        return counted


@contextmanager
def counted(*methods):
    """Counts calls of (owner, name) pairs: yields the list of the names called."""
    calls = []
    originals = [(owner, name, getattr(owner, name)) for owner, name in methods]

    def counting(name, original):
        return lambda *arguments, **named: calls.append(name) or original(*arguments, **named)

    for owner, name, original in originals:
        setattr(owner, name, counting(name, original))
    try:
        yield calls
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)


def set_up(comm, terms, density=True):
    """Dynamics of these terms, and particles on a lattice."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    z = (np.arange(slab.start, slab.stop) + 0.5) * SPACING
    across = (np.arange(PER_SIDE) + 0.5) * SPACING
    position = np.stack(np.meshgrid(across, across, z, indexing="ij"), axis=-1).reshape(-1, 3)
    columns = {"id": np.arange(len(position)) + slab.start * PER_SIDE**2, "position": position,
               "velocity": np.sin(position[:, [1, 2, 0]]), "density": np.ones(len(position))}
    if not density:
        del columns["density"]
    particles = ParticleSet.from_numpy(columns)
    lagrangian = model(terms, FlowUnits(SCALES, 1.5 * SPACING, 14.0))
    return ParticleDynamics(slab, lagrangian, SPACING), particles


def particle_step(comm, terms, density=True):
    """A function that takes a step of velocity Verlet, halo and list being there; the rates are evaluated once."""
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


def trainer(comm, weights):
    """A trainer of the model with an own density on one frame."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    position = np.random.default_rng(3).uniform(0, LENGTH, (PER_SIDE**3, 3))
    position = position[slab.owner_of(position[:, 2]) == comm.rank]
    ids = np.arange(len(position)) + (0 if comm.rank == 0 else PER_SIDE**3 - len(position))
    particles = ParticleSet.from_numpy({"id": ids, "position": position, "velocity": np.sin(position[:, [1, 2, 0]]),
                                        "density": np.ones(len(position))})
    learned = model(OWN_DENSITY, FlowUnits(SCALES, 1.7 * SPACING, 20.0))
    truth = torch.from_numpy(np.cos(position))
    frame = TrainingFrame(ParticleDynamics(slab, learned, 0.0), particles, truth, truth[:, 0])
    return ForceTrainer(learned, [frame], WendlandC2(1.7 * SPACING), weights, 100, seed=5)


def combined_step(comm, **weights):
    """A function that takes a step on all losses with these weights; the others are zero."""
    counting = CountingComm(comm)
    learner = trainer(counting, LossWeights(**weights))
    optimizer = Adam(counting, learner.model.parameters(), 9, 1e-2, 1e-3)
    learner.combined_step(optimizer, 0)
    counting.sent.clear()
    return lambda: learner.combined_step(optimizer, 1), counting.sent


def losses_called(comm, **weights):
    """What a step with these losses calls, and what it sends."""
    step, sent = combined_step(comm, **weights)
    with counted((force_training, "reconstruct"), (force_training, "soft_histogram"),
                 (force_training, "NeighborList")) as calls:
        step()
    return calls, sent


def fluid_of(comm, compressible, forced):
    """Grid, fluid and state."""
    grid = SpectralGrid(SlabDecomposition(comm, LENGTH, 12))
    state = initial_fields.random_velocity(grid, 3, 1.0, 2.0)
    forcing = LinearForcing(grid, 0.5, 2.0) if forced else None
    if not compressible:
        return grid, IncompressibleFluid(grid, 0.1, forcing=forcing), state
    density = initial_fields.balanced_density(grid, state, 10.0)
    return grid, CompressibleFluid(grid, 0.1, 10.0, forcing), np.concatenate([state, density[None]])


def evaluation(comm, compressible, forced):
    """What an evaluation sends, by name, and how many bytes its transforms carry."""
    counting = CountingComm(comm)
    _, fluid, state = fluid_of(counting, compressible, forced)
    counting.sent.clear()
    counting.bytes = 0
    fluid.nonlinear(state)
    return counting.sent, counting.bytes


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset", PRESETS)
def test_one_rank_sends_nothing(comm, preset):
    assert messages_of(comm, {**PRESETS[preset], **FORCING}) == []
    calls, sent = losses_called(comm, field=1.0, velocity_kl=0.1, acceleration_kl=0.1)
    assert sent == []


@pytest.mark.mpi(2)
def test_a_force_pays_with_messages_for_what_it_has_alone(comm):
    assert messages_of(comm, {}) == []
    learned = messages_of(comm, OWN_DENSITY)
    # Votes on the list before the step and at its end; then position, velocity, density: up and down.
    assert sorted(learned) == ["Allreduce"] * 2 + ["Sendrecv"] * 6
    # Who reads no density sends none, and neither do pairs that look at distances alone send velocities.
    assert sorted(messages_of(comm, NO_DENSITY, density=False)) == ["Allreduce"] * 2 + ["Sendrecv"] * 4


@pytest.mark.mpi(2)
def test_a_model_pays_with_transposes_for_the_terms_that_it_has_alone(comm):
    def of(*words):
        settings = {**PRESETS["resolved + pairs"], **FORCING}
        return messages_of(comm, {word: settings.get(word, {}) for word in words})

    sent = {words: of(*words) for words in (
        ("pairs",), ("pressure",), ("stress",), ("damping",), ("relaxation",), ("injection",), ("pressure", "stress"),
        ("pressure", "stress", "damping", "relaxation"), ("pressure", "stress", "damping", "relaxation", "pairs"))}
    transposes = {words: messages.count("Alltoallv") for words, messages in sent.items()}
    # Of the resolved velocity: a solve that starts from what is foreseen, here well enough that it ends at once: what
    # is missed at the particles and back; then the products, which tell how it changes.
    resolved = 2 + 2
    # The products of the velocity with the filter undone: to the grid, they back. What all terms give as modes goes to
    # the particles once; what is missed there the solve tells.
    assert transposes == {
        ("pairs",): 0, ("pressure",): resolved + 1, ("stress",): resolved + 2 + 1, ("damping",): resolved + 1,
        ("relaxation",): resolved, ("injection",): resolved + 1, ("pressure", "stress"): resolved + 2 + 1,
        ("pressure", "stress", "damping", "relaxation"): resolved + 2 + 1,
        ("pressure", "stress", "damping", "relaxation", "pairs"): resolved + 2 + 1}
    # No ghost particles, but planes of the splines: to the particles and back.
    assert sent["pressure",].count("Sendrecv") % 2 == 0 and len(sent["pairs",]) < len(sent["pressure",])


@pytest.mark.mpi(2)
def test_without_a_pair_sum_no_neighbours_are_searched_and_no_density_travels(comm):
    found = {}
    for name, terms in BESIDE_THE_RESOLVED.items():
        with counted((Neighborhood, "update"), (Context, "sum_pairs")) as calls:
            counting = CountingComm(comm)
            step = particle_step(counting, terms)
            counting.sent.clear()
            step()
        found[name] = calls.count("update"), "sum_pairs" in calls, counting.sent.count("Sendrecv")
    assert found["resolved"][0] == 0
    # Position, velocity and, where somebody reads it, density of ghost particles go up and down.
    for name, messages in (("resolved + pairs", 4), ("told densities", 6)):
        assert found[name][0] > 0 and found[name][1] and found[name][2] == found["resolved"][2] + messages


@pytest.mark.mpi(1, 2)
def test_a_model_without_pairs_has_neither_list_nor_ghosts(comm):
    resolved, both, pairs = (set_up(comm, terms)[0]
                             for terms in (PRESETS["resolved"], PRESETS["resolved + pairs"], OWN_DENSITY))
    assert resolved.neighborhood is None and resolved.resolution is not None
    assert both.neighborhood.cutoff == pairs.neighborhood.cutoff == pairs.model.flow.cutoff
    assert pairs.resolution is None
    nothing, forced = (set_up(comm, terms)[0] for terms in ({}, FORCING))
    assert nothing.neighborhood is None and nothing.resolution is None
    assert forced.neighborhood is None and forced.resolution is not None


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("terms", [PRESETS["resolved"], NO_DENSITY, FORCING, {}],
                         ids=["resolved", "pairs", "forcing", "nothing"])
@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_density_that_no_term_reads_is_neither_computed_nor_kept(comm, terms, integrator):
    dynamics, particles = set_up(comm, terms, density=False)
    with torch.no_grad():
        rates = dynamics.rates(particles)
        end = INTEGRATORS[integrator](dynamics).step(particles, STEP)
    assert rates.density is None and rates.density_rate is None and end.density is None
    assert "density" not in end.columns() and "density" not in end.to_numpy()


@pytest.mark.mpi(1, 2)
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


@pytest.mark.mpi(1, 2)
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
        # Sums over pairs are the same to the last bit; a force on the grid is interpolated with another zero added.
        assert torch.allclose(found.acceleration, expected.acceleration, rtol=0, atol=1e-14)
        assert torch.allclose(found.density, expected.density, rtol=0, atol=1e-15)


@pytest.mark.mpi(1)
def test_a_term_that_is_not_there_is_not_evaluated(comm):
    found = {}
    for name, terms in (("none", {"pairs": {}}), ("both", {"pairs": {}, "eddy-viscosity": {}})):
        step = particle_step(comm, terms)
        with counted((EddyViscosity, "rates_of"), (ResolvedVelocity, "of"), (Context, "without_mean")) as calls:
            step()
        found[name] = calls
    assert found["none"] == [] and set(found["both"]) == {"rates_of"}


@pytest.mark.mpi(1)
def test_a_given_density_has_no_flux(comm):
    given = model({"pressure": {}, "pairs": {}})
    names = {name for name, _ in given.named_parameters()}
    assert names and all(name.startswith("terms.pairs.network") for name in names)
    assert len(given.terms["pairs"].network.biases[-1]) == 2


@pytest.mark.mpi(1, 2)
def test_a_loss_without_weight_is_not_evaluated(comm):
    everything, sent = losses_called(comm, field=1.0, velocity_kl=0.1, acceleration_kl=0.1)
    assert sorted(everything) == ["NeighborList", "reconstruct"] + ["soft_histogram"] * 4
    nothing, fewest = losses_called(comm)
    assert nothing == []
    assert sorted(losses_called(comm, field=1.0)[0]) == ["NeighborList", "reconstruct"]
    assert losses_called(comm, velocity_kl=0.1)[0] == ["soft_histogram"] * 2
    assert losses_called(comm, acceleration_kl=0.1)[0] == ["soft_histogram"] * 2
    assert comm.size == 1 or len(fewest) < len(sent)


@pytest.mark.mpi(2)
def test_a_flow_pays_for_neither_density_nor_forcing_that_it_does_not_have(comm):
    sent = {(compressible, forced): evaluation(comm, compressible, forced)
            for compressible in (False, True) for forced in (False, True)}
    for compressible in (False, True):
        (plain, plain_bytes), (forced, forced_bytes) = sent[compressible, False], sent[compressible, True]
        assert "Allreduce" not in plain and "Allreduce" in forced and plain_bytes == forced_bytes
    assert sent[False, False][1] < sent[True, False][1]


@pytest.mark.mpi(1)
def test_a_communicator_that_counts_passes_on(comm):
    comm = CountingComm(comm)
    assert comm.allreduce(3) == 3 and comm.sent == ["allreduce"]
