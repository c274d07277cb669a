"""What an evaluation of particles is said to work on and to send: against what it does, counted."""

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from eddies.parallel.halo import HaloExchange
from eddies.parallel.migration import Redistribution
from eddies.parallel.plane_halo import PlaneHalo
from eddies.parallel.reduction import global_max, global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.parallel.transpose import TransposeBuffers
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.neighborhood import at_home
from eddies.particles.particle_set import ParticleSet
from eddies.scene.integrators import SCHEMES
from eddies.scene.scene import BOX_LENGTH, load_scene
from eddies.workflows.foreseen.network import Network
from eddies.workflows.foreseen.particle_cost import components, part_calls
from eddies.workflows.foreseen.particle_probe import probe_particles, probed_model
from eddies.workflows.foreseen.particle_work import (SUMS_OF_EVALUATION, SUMS_OF_ITERATION, SUMS_OF_SETTLING, VECTOR,
                                                     ParticleWork, particle_work)
from eddies.workflows.foreseen.rollout_course import rollout_step

SIDE, ITERATIONS = 18, 2
TOLD_DENSITIES = 'model.pairs.inputs=["density", "distance", "speed", "approach"]'


class CountingSums:
    """A communicator that counts sums and votes."""

    def __init__(self, comm):
        self.rank, self.size, self._comm, self.sums = comm.rank, comm.size, comm, 0

    def __getattr__(self, name):
        self.sums += name == "Allreduce"
        return getattr(self._comm, name)


def scene_of(preset, *changes):
    return load_scene("hit-small", [f"model.preset={preset}", f"tracers.particles_per_side={SIDE}", *changes])


def run_of(scene, comm):
    """Dynamics of a scene's model with initial weights, and its particles at random in a flow of one wave."""
    slab, dtype = SlabDecomposition(comm, BOX_LENGTH, scene.tracers.planes), getattr(torch, scene.simulation.precision)
    model = probed_model(scene, scene.tracers.particles_per_side).to(dtype)
    dynamics = ParticleDynamics(slab, model, scene.simulation.skin * scene.interaction_radius, dtype)
    if dynamics.resolution is not None:
        dynamics.resolution.iterations = ITERATIONS
    position = np.random.default_rng(4).uniform(0, BOX_LENGTH, (scene.tracers.particles, 3))
    ids = np.flatnonzero(slab.owner_of(position[:, 2]) == comm.rank)
    columns = {"id": ids, "position": position[ids], "velocity": np.sin(position[ids][:, [1, 2, 0]])}
    if model.integrates_density:
        columns["density"] = np.ones(len(ids))
    settled = at_home(slab, {name: torch.from_numpy(column) for name, column in columns.items()}, slab.spacing)
    return dynamics, ParticleSet(**settled)


@pytest.fixture
def counted(monkeypatch):
    """Messages and bytes of what is sent, by class."""
    messages, sizes = Counter(), Counter()

    def count(owner, name):
        original = getattr(owner, name)

        def counting(self, sent, *others):
            messages[owner] += 1
            sizes[owner] += np.asarray(sent).nbytes
            return original(self, sent, *others)

        monkeypatch.setattr(owner, name, counting)

    for owner, name in ((TransposeBuffers, "_send"), (PlaneHalo, "_exchange"), (HaloExchange, "_exchange"),
                        (Redistribution, "apply")):
        count(owner, name)
    return messages, sizes


@pytest.mark.usefixtures("quick_probes")
@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("changes", [["resolved"], ["resolved + pairs"], ["resolved + pairs", TOLD_DENSITIES],
                                     ["paper"]])
@torch.no_grad()
def test_messages_and_bytes_are_those_of_an_evaluation(comm, changes, counted):
    messages, sizes = counted
    scene = scene_of(*changes)
    speed = probe_particles(scene, comm)
    dynamics, particles = run_of(scene, comm)
    work = replace(particle_work(scene), iterations=ITERATIONS if dynamics.resolution else 0)
    dynamics.rates_after(0.0, particles)
    messages.clear(), sizes.clear()
    dynamics.forget()
    dynamics.rates_after(1e-3, particles)
    calls = part_calls(work, speed)
    assert (messages[TransposeBuffers], messages[PlaneHalo]) == (calls["transforms"], 2 * calls["splines"])
    assert messages[HaloExchange] == (2 * (1 + len(speed.ghost_columns)) if speed.ghost_columns else 0)
    # What stays with its rank is not sent, and ranks are not cut quite evenly.
    transposed = work.transposed_bytes(components(work, speed, "transforms")) * (1 - 1 / comm.size)
    assert float(global_sum(comm, sizes[TransposeBuffers])) == pytest.approx(transposed, rel=0.02)
    assert sizes[PlaneHalo] == work.ghost_plane_bytes(components(work, speed, "splines"))
    received = float(global_sum(comm, sizes[HaloExchange])) / comm.size
    assert received == pytest.approx(work.ghosts(comm.size) * sum(speed.ghost_columns), rel=0.1)


@pytest.mark.mpi(2)
@torch.no_grad()
def test_sums_over_ranks_are_those_of_an_evaluation(comm):
    counting = CountingSums(comm)
    dynamics, particles = run_of(scene_of("resolved + pairs"), counting)
    dynamics.rates_after(0.0, particles)
    found = []
    for dynamics.resolution.iterations in (1, 4):
        counting.sums = 0
        dynamics.forget()
        particles, _ = dynamics.settle(particles)
        dynamics.rates_after(1e-3, particles)
        found.append(counting.sums)
    assert found == [SUMS_OF_EVALUATION + SUMS_OF_SETTLING + n * SUMS_OF_ITERATION for n in (1, 4)]


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("preset", ["resolved", "paper"])
@pytest.mark.parametrize("integrator", SCHEMES)
@torch.no_grad()
def test_particles_settle_as_often_and_with_as_many_columns(comm, preset, integrator, counted):
    messages, sizes = counted
    scene = scene_of(preset, f"simulation.integrator={integrator}", "simulation.step=0.1")
    dynamics, particles = run_of(scene, comm)
    stepper, work = INTEGRATORS[integrator](dynamics), particle_work(scene)
    particles = stepper.step(particles, 0.01)
    messages.clear(), sizes.clear()
    dynamics.evaluations = 0
    dynamics.forget()
    stepper.step(particles, 0.01)
    assert dynamics.evaluations == SCHEMES[integrator].evaluations
    places = dynamics.evaluations / work.together
    assert messages[Redistribution] / places == pytest.approx(work.settled_columns())
    bytes_each = float(global_sum(comm, sizes[Redistribution])) / scene.tracers.particles / places
    assert bytes_each == pytest.approx(work.settled_bytes())


@pytest.mark.mpi(1, 2, 3)
@torch.no_grad()
def test_pairs_particles_and_ghosts_of_a_rank(comm):
    scene = scene_of("paper")
    dynamics, particles = run_of(scene, comm)
    work, around = particle_work(scene), dynamics.neighborhood
    dynamics.context(particles)
    own, radius = len(particles), work.radius
    seen = np.mod(around.local(particles.position).position.numpy(), BOX_LENGTH)
    owns, ghosts = (cKDTree(positions, boxsize=BOX_LENGTH) for positions in (seen[:own], seen[own:]))
    pairs = len(owns.query_pairs(radius, output_type="ndarray")) + owns.count_neighbors(ghosts, radius)
    means = np.array([float(global_sum(comm, value)) for value in (own, around.halo.count, pairs)]) / comm.size
    assert work.planes(comm.size) == int(global_max(comm, around.decomposition.count))
    # The model is of the thickest slab.
    thickest = work.planes(comm.size) * comm.size / work.cells
    assert means[0] * thickest == pytest.approx(work.own(comm.size))
    assert means[1] == pytest.approx(work.ghosts(comm.size), rel=0.05)
    assert means[2] * thickest == pytest.approx(work.pairs(comm.size), rel=0.05)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("changes", [[], ["simulation.skin=1.0"], ["flow.viscosity=0.05"]])
def test_grid_is_that_of_the_resolved_velocity(comm, changes):
    scene = scene_of("resolved + pairs", *changes)
    dynamics, work = run_of(scene, comm)[0], particle_work(scene)
    grid, halo = dynamics.resolution.grid, dynamics.resolution.grid.spline._halo
    assert (grid.resolved, grid.spectral.cells, halo.below + halo.above) == (work.wavenumber, work.cells,
                                                                             work.ghost_planes())
    assert int(global_max(comm, np.prod(grid.spectral.spectral_shape))) == work.modes(comm.size)


def test_particles_leave_a_slab_as_fast_as_normal_velocities_take_them():
    work = ParticleWork(particles=10**6, cells=10, drift=0.01)
    z = np.random.default_rng(1).uniform(0, BOX_LENGTH, 10**6)
    moved = z + 0.01 * np.random.default_rng(2).normal(size=10**6)
    thickness = BOX_LENGTH / 5
    left = np.floor(z / thickness) != np.floor(moved / thickness)
    assert left.sum() / 5 == pytest.approx(work.movers(), rel=0.05)


def test_steps_of_a_rollout_are_those_of_the_scene_or_less():
    assert rollout_step(load_scene("hit-small")) <= 0.13
    assert rollout_step(load_scene("hit-small", ["simulation.step=0.01"])) == 0.01


def test_one_rank_sends_nothing_and_neighbours_on_other_nodes_share_its_network():
    alone = Network(1, 1e9)
    assert alone.all_to_all(1e9, 5) == alone.to_neighbors(1e9, 5) == alone.sum_over_ranks(5) == 0
    from eddies.workflows.foreseen.network import LATENCY, NODE_BANDWIDTH, NODE_CORES
    assert [Network(2 * NODE_CORES, 1e9, threads).nodes for threads in (1, 2, NODE_CORES)] == [2, 4, 2 * NODE_CORES]
    within, ends, apart = (Network(ranks, 1e9, threads).to_neighbors(1e9, 2) - 2 * LATENCY for ranks, threads in (
        (NODE_CORES, 1), (2 * NODE_CORES, 1), (2, NODE_CORES)))
    assert (within, ends, apart) == pytest.approx((2, 1 + 1e9 / NODE_BANDWIDTH, 2e9 / NODE_BANDWIDTH))
    assert VECTOR == np.zeros(3).nbytes
