import numpy as np
import pytest
import torch

from eddies.analysis.figures_learning import LOSSES
from eddies.flow.tracers import release
from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.optimization import Descent
from eddies.learning.training import Phase, Training, TrainingDiverged
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.pair_forces import PairModel
from eddies.particles.particle_set import ParticleSet
from eddies.particles.poisson_closure import ResolvedForce
from eddies.particles.reference_scales import ReferenceScales
from eddies.particles.smoothing_kernels import WendlandC2

LENGTH, PER_SIDE = 2 * np.pi, 12
SPACING = LENGTH / PER_SIDE
SUPPORT = 2.2 * SPACING
SCALES = ReferenceScales(length=2 * SPACING, spacing=SPACING, velocity=1.0, density_mean=1.0, density=0.01,
                         acceleration=1.0, density_rate=0.02, sound_speed=10.0, viscosity=0.01)


def frame_of(comm, model, forced=False):
    """Particles in a smooth flow whose acceleration is a pressure gradient and a drag."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    columns = release(slab, 3, PER_SIDE, "random")
    x, y, z = columns["position"].T
    velocity = np.stack([np.sin(y), np.sin(z), np.sin(x)], axis=1)
    density = 1 + 0.01 * np.cos(x) * np.cos(y)
    acceleration = np.stack([np.sin(x) * np.cos(y), np.cos(x) * np.sin(y), 0 * z], axis=1) - 0.3 * velocity
    particles = ParticleSet.from_numpy({**columns, "velocity": velocity, "density": density})
    force = None
    if forced:
        terms = [particles.velocity.roll(1, 1), *((number * particles.velocity).cos() for number in range(7))]
        force = ResolvedForce(0.5 * particles.velocity, torch.stack(terms), model.resolved_factors)
    return TrainingFrame(slab, model, particles, torch.from_numpy(acceleration), torch.from_numpy(0.02 * np.sin(y)),
                         force)


def trainer_of(comm, closure="learned-density", weights=LossWeights(1.0, 1.0, 0.1, 0.1), batch=300):
    model = PairModel(SCALES, SUPPORT, 45, (8, 8), closure=closure, seed=2)
    frame = frame_of(comm, model)
    return ForceTrainer(model, [frame], WendlandC2(SUPPORT), weights, batch, seed=5)


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("kind", ["trajectory_step", "combined_step"])
def test_training_is_the_same_on_any_number_of_ranks(comm, kind):
    from mpi4py import MPI

    def losses_and_weights(communicator):
        trainer = trainer_of(communicator)
        descent = Descent(communicator, trainer.model.parameters(), 5, 1e-2, 1e-3)
        rows = [getattr(trainer, kind)(descent, step) for step in range(5)]
        return rows, torch.cat([p.detach().flatten() for p in trainer.model.parameters()])

    (rows, weights), (alone, weights_alone) = losses_and_weights(comm), losses_and_weights(MPI.COMM_SELF)
    for row, other in zip(rows, alone):
        assert row == pytest.approx(other, rel=1e-9)
    assert torch.allclose(weights, weights_alone, rtol=1e-9, atol=1e-12)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("kind", ["trajectory_step", "combined_step"])
def test_gradient_against_finite_differences(comm, kind):
    trainer = trainer_of(comm)

    class Recorder:
        """Takes no step but keeps the share."""

        def step(self, share):
            self.share = share
            return 0.0

    def loss():
        recorder = Recorder()
        getattr(trainer, kind)(recorder, 0)
        return recorder.share

    loss().backward()
    weight = trainer.model.network.weights[0]
    gradient, epsilon = float(weight.grad[1, 2]), 1e-5
    values = []
    for sign in (1, -1):
        with torch.no_grad():
            weight[1, 2] += sign * epsilon
            values.append(float(loss()))
            weight[1, 2] -= sign * epsilon
    # The error of a central difference is epsilon^2; the histogram's kinks between bins add a little.
    assert (values[0] - values[1]) / (2 * epsilon) == pytest.approx(gradient, rel=1e-3)


@pytest.mark.mpi(1)
def test_training_lowers_the_error_of_a_learnable_force(comm):
    trainer = trainer_of(comm, closure="poisson", weights=LossWeights())
    descent = Descent(comm, trainer.model.parameters(), 150, 1e-2, 1e-3)
    losses = [trainer.trajectory_step(descent, step)["loss"] for step in range(150)]
    # The pressure gradient and drag are in the span of the model; what is left is the
    # scatter of differences between randomly placed particles.
    assert np.mean(losses[-20:]) < 0.15 * losses[0]


@pytest.mark.mpi(1, 2, 3)
def test_the_error_of_all_losses_is_that_of_the_acceleration_where_nothing_else_has_weight(comm):
    trainer = trainer_of(comm, weights=LossWeights(trajectory=4.0), batch=10**6)
    frame = trainer.frames[0]
    with torch.no_grad():
        squares = global_sum(comm, float(frame.errors()["velocity"].square().sum()))
    expected = 2 * (squares / (3 * frame.total)) ** 0.5 / frame.acceleration_rms
    assert trainer.combined_error(frame, draws=3) == pytest.approx(expected, rel=1e-12)


@pytest.mark.mpi(2, 3)
def test_the_error_of_all_losses_is_the_same_on_any_number_of_ranks_and_at_every_call(comm):
    from mpi4py import MPI
    trainer, alone = trainer_of(comm), trainer_of(MPI.COMM_SELF)
    error = trainer.combined_error(trainer.frames[0], draws=3)
    assert error == trainer.combined_error(trainer.frames[0], draws=3)
    assert error == pytest.approx(alone.combined_error(alone.frames[0], draws=3), rel=1e-9)


@pytest.mark.mpi(1, 2)
def test_a_force_that_is_not_a_number_ends_the_training_on_all_ranks(comm):
    """Found in the loss of the step, also on ranks that own no particle of its cube."""
    trainer = trainer_of(comm)
    with torch.no_grad():
        trainer.model.network.biases[-1][0] = torch.nan
    phase = Phase("all losses", np.ones(3), (1e-2, 1e-3), trainer.combined_step,
                  lambda: trainer.combined_error(trainer.frames[0], 2), 1)
    with pytest.raises(TrainingDiverged, match="step 0 of the training .all losses.: loss is nan"):
        Training(comm, trainer.model, [phase]).step()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("closure, counts", [("learned-density", False), ("paper-density", True)])
def test_of_learned_rates_of_density_only_the_paper_s_counts_in_single_frames(comm, closure, counts):
    trainer = trainer_of(comm, closure, weights=LossWeights())
    trainer.trajectory_step(Descent(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0)
    flux = trainer.model.network.weights[-1].grad[2]
    assert bool(flux.any()) == counts
    if closure == "learned-density":
        assert trainer.model.density_factors.grad is None or not trainer.model.density_factors.grad.any()


@pytest.mark.mpi(1, 2, 3)
def test_the_force_of_a_closure_is_added_to_the_pair_sum_and_its_factors_are_learned(comm):
    model = PairModel(SCALES, SUPPORT, 45, (8, 8), closure="poisson-stress", seed=2)
    pairs_alone, frame = frame_of(comm, model), frame_of(comm, model, forced=True)
    factors, rows = model.resolved_factors().detach(), frame.rows(np.arange(0, frame.total, 3))
    with torch.no_grad():
        terms = sum(factor * term[rows] for factor, term in zip(factors, frame.force.terms))
        expected = pairs_alone.errors(rows)["velocity"] + frame.force.constant[rows] + terms
        assert torch.allclose(frame.errors(rows)["velocity"], expected, rtol=1e-13, atol=1e-13)
        error = frame.errors()["velocity"]
    trainer = ForceTrainer(model, [frame], WendlandC2(SUPPORT), LossWeights(), frame.total, seed=5)
    units = factors / model.force_factors.detach()
    trainer.trajectory_step(Descent(comm, model.parameters(), 1, 1e-2, 1e-2), 0)
    # Of the mean square of the error, which is linear in the factors.
    slopes = units * (2 * error * frame.force.terms).sum((1, 2)) / (3 * frame.total * frame.acceleration_rms**2)
    assert model.force_factors.grad.numpy() == pytest.approx(global_sum(comm, slopes.numpy()), rel=1e-11)


@pytest.mark.mpi(1)
def test_every_loss_has_a_name_that_the_learning_curves_know(comm):
    trainer = trainer_of(comm)
    row = trainer.combined_step(Descent(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0)
    names = {"loss", "trajectory_loss", "field_loss", "velocity_kl_loss", "acceleration_kl_loss"}
    assert set(row) == names | {"gradient_norm"} and names <= {name for name, *_ in LOSSES}
    weighted = sum(weight * row[f"{name}_loss"] for name, weight in vars(trainer.weights).items())
    assert row["loss"] == pytest.approx(weighted, rel=1e-12)


@pytest.mark.mpi(1, 2)
def test_losses_without_weight_are_not_computed(comm, monkeypatch):
    for name in ("_field_share", "_divergence"):
        monkeypatch.setattr(ForceTrainer, name, lambda *args: pytest.fail("an unused loss was computed"))
    rows = []
    for kind in ("trajectory_step", "combined_step"):
        trainer = trainer_of(comm, weights=LossWeights())
        rows.append(getattr(trainer, kind)(Descent(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0))
    assert set(rows[0]) == {"loss", "trajectory_loss", "gradient_norm"}
    # Without the field loss there is no cube: both draw the same batch.
    assert rows[0] == rows[1]
