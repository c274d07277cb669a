from dataclasses import replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.flow.tracers import release
from eddies.learning.training import shared_values
from eddies.learning.rollout_training import RolloutTrainer, TrainingWindow, energy_units
from eddies.parallel.migration import IdOrder
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.particle_set import ParticleSet
from eddies.particles.resolved_velocity import ResolvedVelocity
from tests.learning.models import LENGTH, PER_SIDE, SCALES, SPACING, Recorder, model_of, slope
from tests.particles.configurations import OWN_DENSITY

FRAMES, INTERVAL = 4, 0.06
SUPPORT = 1.6 * SPACING
ITERATIONS = 8  # of each solve for the resolved velocity, on any number of ranks


def resolution(slab):
    return solving(ResolvedVelocity.on_slabs(slab, SCALES), ITERATIONS)


def solving(resolved, iterations):
    """Let each solve take so many iterations; None: until its residual is below the error of differences of losses."""
    resolved.iterations = iterations
    resolved.tolerance = resolved.tolerance_predicted = resolved.tolerance_adjoint = 1e-10
    return resolved


def window_of(slab, with_density):
    """Particles in a smooth flow that changes slowly and moves along z, with true velocities, and energies that decay
    by a tenth in each frame. Particles without acceleration keep their energies."""
    columns = release(slab, 3, PER_SIDE**3, "random")
    x, y, z = columns["position"].T

    def velocity(turned):
        return np.stack([np.sin(y + turned), np.sin(z + turned), 9 + np.sin(x + turned)], axis=1)

    def density(turned):
        return 1 + 0.01 * np.cos(x + turned) * np.cos(y)

    times = INTERVAL * np.arange(1, FRAMES + 1)
    later = {"velocity_later": np.stack([velocity(time) for time in times], axis=1),
             "density_later": np.stack([density(time) for time in times], axis=1)}
    order = IdOrder(slab.comm, columns["id"], PER_SIDE**3)
    columns = {name: torch.from_numpy(order.apply(column)) for name, column in {
        **columns, "velocity": velocity(0.0), "density": density(0.0), **later}.items()}
    true = {name: columns.pop(f"{name}_later").movedim(1, 0).contiguous() for name in ("velocity", "density")}
    if not with_density:
        del columns["density"], true["density"]
    particles = ParticleSet(**columns)
    start = resolution(slab).band_energies(particles)
    energies = torch.stack([start * 0.9**frame for frame in range(1, FRAMES + 1)])
    return TrainingWindow(particles, true["velocity"], true.get("density"), energies, start.expand_as(energies))


def trainer_of(comm, preset="resolved + pairs", integrator="verlet", steps=1, iterations=ITERATIONS):
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    model = model_of(preset, SUPPORT, 17, (6, 5))
    dynamics = ParticleDynamics(slab, model, 0.0, torch.float64)
    if dynamics.resolution is not None:
        solving(dynamics.resolution, iterations)
    window = window_of(slab, model.integrates_density)
    trainer = RolloutTrainer(comm, INTEGRATORS[integrator](dynamics), [window], INTERVAL, steps, 0.5,
                             solving(resolution(slab), iterations), 5)
    return trainer, model


def gradient_of(comm, horizon, **choices):
    trainer, model = trainer_of(comm, **choices)
    recorder = Recorder(comm, model)
    loss = trainer.step(recorder, 0, horizon)["loss"]
    return loss, recorder.gradient


@pytest.mark.parametrize("preset", ["resolved + pairs", OWN_DENSITY])
@pytest.mark.mpi(3)
def test_gradient_is_the_same_on_any_number_of_ranks(comm, preset):
    loss, gradient = gradient_of(comm, FRAMES, preset=preset)
    alone, expected = comm.bcast(gradient_of(MPI.COMM_SELF, FRAMES, preset=preset) if comm.rank == 0 else None)
    assert loss == pytest.approx(alone, rel=1e-11)
    assert np.linalg.norm(gradient - expected) < 1e-10 * np.linalg.norm(expected)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, integrator, steps, horizon", [
    *((OWN_DENSITY, integrator, 2, 2) for integrator in INTEGRATORS), ("resolved + pairs", "verlet", 1, 2)])
def test_gradient_through_several_steps_against_finite_differences(comm, preset, integrator, steps, horizon):
    trainer, model = trainer_of(comm, preset, integrator, steps, iterations=None)
    recorder = Recorder(comm, model)
    trainer.step(recorder, 0, horizon)

    def loss():
        return sum(shared_values(comm, trainer.loss_shares(trainer.windows[0], horizon)).values())

    found, expected = slope(model, loss, recorder.gradient, 1e-5)
    # A difference has an error of epsilon^2, and kinks of second order where pairs enter or leave the support.
    assert found == pytest.approx(expected, rel=1e-5)


@pytest.mark.mpi(1)
def test_gradient_with_the_tolerance_of_training(comm):
    """It differs from that of solves to 1e-10 by less than 1 %, far below the difference between windows. The energies
    of a frame are solved for once."""
    def gradient(adjoint):
        trainer, model = trainer_of(comm, iterations=None)
        for resolved in (trainer.resolution, trainer.integrator.dynamics.resolution):
            resolved.tolerance_adjoint = adjoint
        recorder = Recorder(comm, model)
        trainer.step(recorder, 0, FRAMES)
        return recorder.gradient, [iterations for iterations, *_ in trainer.resolution.solves]

    (exact, _), (found, iterations) = gradient(1e-10), gradient(ResolvedVelocity.tolerance_adjoint)
    assert 0 < np.linalg.norm(found - exact) < 0.01 * np.linalg.norm(exact)
    # Solves of each frame: for the energies, for the same again on the way back, and for their gradient.
    assert len(iterations) == 3 * FRAMES and iterations.count(0) == FRAMES


@pytest.mark.mpi(3)
def test_particles_cross_a_slab_within_a_window(comm):
    """The tests of ranks cover this: the flow along z carries particles to the rank after the next."""
    trainer, _ = trainer_of(comm)
    window = trainer.windows[0]
    with torch.no_grad():
        *_, (_, particles) = trainer._frames(window.particles, FRAMES)
    slab = trainer.integrator.dynamics.decomposition
    assert torch.equal(particles.id, window.particles.id)  # they come back in their order
    moved = particles.position[:, 2] - window.particles.position[:, 2]
    assert global_max(comm, float(moved.max())) > slab.planes // slab.size * slab.spacing


@pytest.mark.mpi(1)
def test_memory_does_not_grow_with_the_steps(comm):
    def kept(horizon):
        """Bytes kept for the gradient, and the loss."""
        trainer, _ = trainer_of(comm)
        held = {}

        def pack(tensor):
            held[tensor.untyped_storage().data_ptr()] = tensor.untyped_storage().nbytes()
            return tensor

        with torch.autograd.graph.saved_tensors_hooks(pack, lambda tensor: tensor):
            shares = trainer.loss_shares(trainer.windows[0], horizon)
        return sum(held.values()), sum(shares.values())

    (one, first), (four, _) = kept(1), kept(4)
    assert first.requires_grad
    # A state is a few columns of the particles; the pairs of one evaluation hold a hundred times as much.
    columns = 8 * 12 * PER_SIDE**3
    assert four - one < 3 * 4 * columns


@pytest.mark.mpi(2)
def test_without_a_weight_windows_need_no_energies(comm):
    with_energies, _ = trainer_of(comm)
    windows = [replace(window, energies=None, unforced=None) for window in with_energies.windows]
    trainer = RolloutTrainer(comm, with_energies.integrator, windows, INTERVAL, 1, 0.0, None, 5)
    shares, expected = (each.loss_shares(each.windows[0], 2) for each in (trainer, with_energies))
    assert shares == {"rollout_loss": expected["rollout_loss"]}


@pytest.mark.mpi(1)
def test_the_energies_count_in_units_of_the_error_without_acceleration(comm):
    window = (trainer := trainer_of(comm)[0]).windows[0]
    assert float(trainer._energy_share(window, 1, window.particles).detach()) == pytest.approx(1, rel=1e-9)
    # Bands by columns. The error of the first is below a tenth of that of the second in the first frame.
    one, other = (replace(window, energies=torch.ones(2, 2), unforced=torch.tensor(unforced))
                  for unforced in ([[1.0, 2.0], [1.5, 1.0]], [[1.01, 1.0], [1.5, 3.0]]))
    root = 0.5**0.5
    assert torch.allclose(energy_units([one, other]), torch.tensor([[0.1 * root, root], [0.5, 2 * root]]))


@pytest.mark.mpi(1)
def test_no_acceleration_has_an_error_of_one(comm):
    trainer, model = trainer_of(comm, preset=("damping", "relaxation"))
    trainer.energy_weight = 0.0
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.zero_()
    assert trainer.validation_error(trainer.windows[0], FRAMES) == pytest.approx(1, rel=1e-9)
