"""A scene pays for nothing that it does not have: calls, transforms and messages, counted."""

from contextlib import contextmanager

import numpy as np
import pytest
import torch

from eddies.flow import initial_fields
from eddies.flow.forcing import LinearForcing
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.learning import force_training
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.optimization import Descent
from eddies.parallel.slab import SlabDecomposition
from eddies.particles import body_forces
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.eddy_viscosity import EddyViscosity
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.neighbor_list import NeighborList
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.reference_scales import ReferenceScales
from eddies.particles.smoothing_kernels import WendlandC2
from eddies.workflows.closures import density_closure

LENGTH, PER_SIDE, STEP = 2 * np.pi, 9, 0.001
SPACING = LENGTH / PER_SIDE
SCALES = ReferenceScales(length=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0, density=0.01,
                         acceleration=1.0, density_rate=0.02, sound_speed=10.0, viscosity=0.01)


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


def particle_step(comm, closure="poisson", viscosity="none", basis="corrected", forced=False, pairs=True):
    """A function that takes a step of velocity Verlet, halo and list being there; the rates are evaluated once."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    z = (np.arange(slab.start, slab.stop) + 0.5) * SPACING
    across = (np.arange(PER_SIDE) + 0.5) * SPACING
    position = np.stack(np.meshgrid(across, across, z, indexing="ij"), axis=-1).reshape(-1, 3)
    velocity = np.sin(position[:, [1, 2, 0]])
    ids = np.arange(len(position)) + slab.start * PER_SIDE**2
    particles = ParticleSet.from_numpy({"id": ids, "position": position, "velocity": velocity,
                                        "density": np.ones(len(position))})
    model = PairModel(SCALES, 1.5 * SPACING, 14, (8,), basis, closure, viscosity)
    density = density_closure(model, slab, torch.float64, SPACING) if pairs else None
    terms = model.pair_terms if pairs else []
    terms += [body_forces.LinearForcing(0.5, 2.0, comm)] if forced else []
    stepper = INTEGRATORS["verlet"](ParticleDynamics(slab, LENGTH, terms, SPACING, density))
    with torch.no_grad():
        state = [stepper.step(particles, STEP)]

    @torch.no_grad()
    def step():
        state[0] = stepper.step(state[0], STEP)

    return step


def messages_of(comm, **choices):
    counting = CountingComm(comm)
    step = particle_step(counting, **choices)
    counting.sent.clear()
    step()
    return counting.sent


def trainer(comm, weights):
    """A trainer of the learned-density closure on one frame."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    position = np.random.default_rng(3).uniform(0, LENGTH, (PER_SIDE**3, 3))
    position = position[slab.owner_of(position[:, 2]) == comm.rank]
    ids = np.arange(len(position)) + (0 if comm.rank == 0 else PER_SIDE**3 - len(position))
    particles = ParticleSet.from_numpy({"id": ids, "position": position, "velocity": np.sin(position[:, [1, 2, 0]]),
                                        "density": np.ones(len(position))})
    model = PairModel(SCALES, 1.7 * SPACING, 20, (8,), closure="learned-density")
    truth = torch.from_numpy(np.cos(position))
    frame = TrainingFrame(slab, model, particles, truth, truth[:, 0])
    return ForceTrainer(model, [frame], WendlandC2(1.7 * SPACING), weights, 100, seed=5)


def combined_step(comm, **weights):
    """A function that takes a step on all losses with these weights; the others are zero."""
    counting = CountingComm(comm)
    learner = trainer(counting, LossWeights(**{"trajectory": 1.0, "field": 0.0, "velocity_kl": 0.0,
                                               "acceleration_kl": 0.0, **weights}))
    descent = Descent(counting, learner.model.parameters(), 9, 1e-2, 1e-3)
    learner.combined_step(descent, 0)
    counting.sent.clear()
    return lambda: learner.combined_step(descent, 1), counting.sent


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
@pytest.mark.parametrize("closure", ["poisson", "poisson-force", "poisson-stress", "learned-density", "paper-density"])
def test_one_rank_sends_nothing(comm, closure):
    assert messages_of(comm, closure=closure, forced=True) == []
    calls, sent = losses_called(comm, field=1.0, velocity_kl=0.1, acceleration_kl=0.1)
    assert sent == []


@pytest.mark.mpi(2)
def test_a_force_pays_with_messages_for_what_it_has_alone(comm):
    nothing = messages_of(comm, pairs=False)
    forcing = messages_of(comm, pairs=False, forced=True)
    learned, forced = messages_of(comm, closure="learned-density"), messages_of(comm, closure="learned-density",
                                                                                forced=True)
    assert nothing == [] and forcing == ["Allreduce"]
    # Votes on the list before the step and at its end; then position, velocity, density: up and down.
    assert sorted(learned) == ["Allreduce"] * 2 + ["Sendrecv"] * 6
    assert sorted(forced) == ["Allreduce"] * 3 + ["Sendrecv"] * 6


@pytest.mark.mpi(2)
def test_a_closure_pays_with_transposes_for_the_terms_of_its_force_alone(comm):
    sent = {closure: messages_of(comm, closure=closure)
            for closure in ("learned-density", "poisson", "poisson-force", "poisson-stress")}
    # Three passes of the field to the particles and what is missed there, two transposes each; the field to modes, its
    # products back and forth, the pressure to the particles. The gradient of the pressure goes with it; the stress has
    # products of its own, and its friction the velocity at the particles once more.
    transposes = {closure: messages.count("Alltoallv") for closure, messages in sent.items()}
    assert transposes == {"learned-density": 0, "poisson": 6 + 4, "poisson-force": 6 + 4,
                          "poisson-stress": 6 + 4 + 2 + 2}
    # Beside the two votes on the list: one on where particles are, their mean velocity, and of a force its mean.
    sums = {closure: messages.count("Allreduce") for closure, messages in sent.items()}
    assert sums == {"learned-density": 2, "poisson": 4, "poisson-force": 5, "poisson-stress": 5}


@pytest.mark.mpi(2)
def test_without_a_pair_sum_no_neighbours_are_searched_and_no_density_travels(comm):
    found = {}
    for basis in ("corrected", "none"):
        with counted((NeighborList, "build"), (NeighborList, "pairs")) as calls:
            counting = CountingComm(comm)
            step = particle_step(counting, "poisson-stress", basis=basis)
            counting.sent.clear()
            step()
        found[basis] = calls.count("build"), calls.count("pairs"), counting.sent.count("Sendrecv")
    # What is left is the list of particles around the points of the grid; the density would go up and down.
    (builds, pairs, sent), (builds_left, pairs_left, sent_left) = found["corrected"], found["none"]
    assert builds_left < builds and pairs_left < pairs and sent_left == sent - 2


@pytest.mark.mpi(1)
def test_without_an_eddy_viscosity_none_is_evaluated(comm):
    found = {}
    for viscosity in ("none", "two-sided"):
        step = particle_step(comm, viscosity=viscosity)
        with counted((EddyViscosity, "forward")) as calls:
            step()
        found[viscosity] = len(calls)
    assert found["none"] == 0 < found["two-sided"]


@pytest.mark.mpi(1)
def test_the_rates_of_a_given_density_have_no_flux(comm):
    models = {closure: PairModel(SCALES, 1.0, 14, (8,), closure=closure) for closure in ("poisson", "paper-density")}
    outputs = {closure: len(model.network.biases[-1]) for closure, model in models.items()}
    assert outputs == {"poisson": 2, "paper-density": 3}


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
