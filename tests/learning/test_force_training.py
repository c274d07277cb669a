from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch

from eddies.flow.tracers import release
from eddies.learning.force_training import FieldLater, ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.optimization import Adam
from eddies.learning.training import Phase, Training, TrainingDiverged
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_field import grid_points
from eddies.particles.particle_set import ParticleSet
from eddies.particles.rates import Rates
from eddies.particles.smoothing_kernels import WendlandC2
from eddies.particles.terms.resolved_forces import Stress
from eddies.particles.terms.term import Term
from eddies.report.learning import LOSSES
from eddies.scene.terms import TermSettings
from tests.learning.models import LENGTH, PER_SIDE, SPACING, Recorder, model_of, slope
from tests.particles.configurations import OWN_DENSITY

SUPPORT = 2.2 * SPACING
ALL = LossWeights(1.0, 0.1, 0.1, 2.0)
PRESETS = [OWN_DENSITY, "paper", "resolved + pairs", "resolved"]
# The density that the pairs read is that of pressure and stress, and a part of it is learned.
THROUGH_DENSITY = ("pressure", f"{__name__}:AmplifiedStress", "pairs")


class AmplifiedStress(Stress):
    """With a learned factor."""

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.amplitude = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context):
        rates = super().forward(context)
        return Rates(force_modes=self.amplitude * rates.force_modes,
                     pressure_modes=self.amplitude * rates.pressure_modes)


@dataclass(frozen=True, kw_only=True)
class ReadsNothing(TermSettings):
    """Settings of an acceleration that looks at each particle alone."""


class BlurredDrag(Term):
    """-rate times a velocity that is told wrongly: with something beside it that has nothing to do with it."""

    Settings = ReadsNothing
    linear = True

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.rate = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, context):
        particles = context.particles
        beside = torch.cos(9 * particles.position.roll(1, dims=1) + particles.position)
        return Rates(acceleration=-self.rate * (particles.velocity + beside))


def frame_of(comm, model, wind=0.0):
    """Particles in a smooth flow whose acceleration is a pressure gradient and a drag, all of them moving with a wind
    as well; without a density where the model does not integrate one."""
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    columns = release(slab, 3, PER_SIDE, "random")
    x, y, z = columns["position"].T
    velocity = np.stack([np.sin(y) + 0.4 * np.cos(z), np.sin(z), np.sin(x)], axis=1)
    density = 1 + 0.01 * np.cos(x) * np.cos(y)
    acceleration = np.stack([np.sin(x) * np.cos(y), np.cos(x) * np.sin(y), 0 * z], axis=1) - 0.3 * velocity
    particles = ParticleSet.from_numpy({**columns, "velocity": velocity + wind, "density": density})
    rate = torch.from_numpy(0.02 * np.sin(y))
    if not model.integrates_density:
        particles, rate = replace(particles, density=None), None
    dynamics = ParticleDynamics(slab, model, 0.0, torch.float64)
    if dynamics.resolution is not None:
        dynamics.resolution.iterations = 8  # on any number of ranks the same ones
    return TrainingFrame(dynamics, particles, torch.from_numpy(acceleration), rate)


def trainer_of(comm, preset=OWN_DENSITY, weights=ALL, batch=300, **settings):
    model = model_of(preset, SUPPORT, 45, (8, 8), **settings)
    return ForceTrainer(model, [frame_of(comm, model)], WendlandC2(SUPPORT), weights, batch, seed=5)


def row_and_gradient(trainer, kind="combined_step"):
    recorder = Recorder(trainer.comm, trainer.model)
    return getattr(trainer, kind)(recorder, 0), recorder.gradient


@pytest.mark.mpi(2, 3)
@pytest.mark.parametrize("preset", [OWN_DENSITY, "resolved + pairs"])
@pytest.mark.parametrize("kind", ["trajectory_step", "combined_step"])
def test_training_is_the_same_on_any_number_of_ranks(comm, kind, preset):
    from mpi4py import MPI

    def losses_and_weights(communicator):
        trainer = trainer_of(communicator, preset)
        optimizer = Adam(communicator, trainer.model.parameters(), 5, 1e-2, 1e-3)
        rows = [getattr(trainer, kind)(optimizer, step) for step in range(5)]
        return rows, torch.cat([p.detach().flatten() for p in trainer.model.parameters()])

    (rows, weights), (alone, weights_alone) = losses_and_weights(comm), losses_and_weights(MPI.COMM_SELF)
    for row, other in zip(rows, alone):
        assert row == pytest.approx(other, rel=1e-9)
    assert torch.allclose(weights, weights_alone, rtol=1e-8, atol=1e-11)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset", [*PRESETS, THROUGH_DENSITY])
@pytest.mark.parametrize("kind", ["trajectory_step", "combined_step"])
def test_gradient_against_finite_differences(comm, kind, preset):
    trainer = trainer_of(comm, preset)
    gradient = row_and_gradient(trainer, kind)[1]

    def loss():
        recorder = Recorder(comm, trainer.model)
        recorder.step = lambda share: 0.0
        return getattr(trainer, kind)(recorder, 0)["loss"]

    found, expected = slope(trainer.model, loss, gradient, 1e-6)
    # The histogram's kinks between bins add to the error of a difference.
    assert found == pytest.approx(expected, rel=1e-3 if kind == "combined_step" else 1e-6)


@pytest.mark.mpi(1, 3)
@pytest.mark.parametrize("preset", ["resolved + pairs", "resolved", THROUGH_DENSITY])
@pytest.mark.parametrize("kind", ["trajectory_step", "combined_step"])
def test_what_is_kept_of_linear_terms_gives_the_same_losses_and_gradients(comm, kind, preset):
    """The claim on which training does not evaluate them again: also where their parameters have moved since."""
    trainer = trainer_of(comm, preset)
    frame, model = trainer.frames[0], trainer.model
    assert frame.kept.keys() == {name for name in model.terms if name != "pairs"}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter *= 1.3
    row, gradient = row_and_gradient(trainer, kind)
    frame.kept = None
    direct, expected = row_and_gradient(trainer, kind)
    assert row == pytest.approx(direct, rel=1e-11)
    assert np.linalg.norm(gradient - expected) < 1e-10 * np.linalg.norm(expected)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset", ["resolved + pairs", "resolved"])
def test_a_step_evaluates_no_linear_term(comm, preset, monkeypatch):
    trainer = trainer_of(comm, preset)
    for name in trainer.frames[0].kept:
        monkeypatch.setattr(trainer.model.terms[name], "forward", lambda context: pytest.fail("evaluated anew"))
    for kind in ("trajectory_step", "combined_step"):
        row_and_gradient(trainer, kind)


@pytest.mark.mpi(1, 2)
def test_the_factor_of_a_stress_is_learned_through_the_density_too(comm):
    """With the density held where it is, its gradient is another one."""
    trainer = trainer_of(comm, THROUGH_DENSITY)
    frame, amplitude = trainer.frames[0], trainer.model.terms["AmplifiedStress"].amplitude
    with torch.no_grad():  # initial weights hardly look at the density
        trainer.model.terms["pairs"].network.weights[0][:, :2] *= 5

    def gradient(**choice):
        amplitude.grad = None
        frame.errors(**choice)["acceleration"].square().sum().backward()
        return float(global_sum(comm, float(amplitude.grad)))

    whole = gradient()
    held = gradient(density=frame.seen().density)
    values, epsilon = [], 1e-5
    with torch.no_grad():
        for sign in (1, -2):
            amplitude += sign * epsilon
            values.append(global_sum(comm, float(frame.errors()["acceleration"].square().sum())))
    assert whole == pytest.approx((values[0] - values[1]) / (2 * epsilon), rel=1e-6)
    assert abs(whole - held) > 1e-3 * abs(whole)


@pytest.mark.mpi(1)
def test_training_lowers_the_error_of_a_learnable_force(comm):
    trainer = trainer_of(comm, weights=LossWeights())
    optimizer = Adam(comm, trainer.model.parameters(), 150, 1e-2, 1e-3)
    losses = [trainer.trajectory_step(optimizer, step)["loss"] for step in range(150)]
    # The pressure gradient and drag are in the span of the model; what is left is the
    # scatter of differences between randomly placed particles.
    assert np.mean(losses[-20:]) < 0.15 * losses[0]


@pytest.mark.mpi(1, 2)
def test_with_a_loss_of_the_power_what_is_told_wrongly_still_takes_the_right_energy_out(comm):
    """Where a drag of rate 0.3 is fitted to a velocity that is told with an error, what fits the acceleration best
    takes too little energy out."""
    rates = {}
    for power in (0.0, 1e4):
        trainer = trainer_of(comm, (f"{__name__}:BlurredDrag",), LossWeights(power=power), batch=10**6)
        optimizer = Adam(comm, trainer.model.parameters(), 300, 3e-2, 1e-4)
        at_first = trainer.one_step_error(trainer.frames[0], 10**6)  # holds both losses
        rows = [trainer.trajectory_step(optimizer, step) for step in range(300)]
        assert (power > 0) == ("power_loss" in rows[-1]) and at_first == pytest.approx(rows[0]["loss"] ** 0.5, rel=1e-9)
        rates[power] = float(trainer.model.terms["BlurredDrag"].rate.detach())
    told = 1 / (1 + 0.5 / (0.5 + 0.16 / 6))  # the variance of a component over that of what is told of it
    assert rates[0.0] == pytest.approx(0.3 * told, rel=0.1)
    assert rates[1e4] == pytest.approx(0.3, rel=0.03)
    # The velocity of all particles together does not count.
    windy = frame_of(comm, trainer.model, wind=7.0)
    assert torch.allclose(windy.fluctuation, trainer.frames[0].fluctuation, rtol=0, atol=1e-12)


@pytest.mark.mpi(1)
def test_a_model_without_networks_trains(comm):
    trainer = trainer_of(comm, "resolved", LossWeights(), batch=10**6)
    assert not trainer.model.networks and trainer.frames[0].dynamics.neighborhood is None
    optimizer = Adam(comm, trainer.model.parameters(), 400, 1e-1, 1e-2)
    losses = [trainer.trajectory_step(optimizer, step)["loss"] for step in range(400)]
    # Their best is the least-squares fit of its seven factors, in which the loss is quadratic.
    frame = trainer.frames[0]
    slopes = torch.cat([frame.kept[name].slopes["acceleration"] for name in frame.kept if frame.kept[name].slopes])
    slopes = slopes.flatten(1)
    given = torch.cat([p.detach().flatten() for name in frame.kept for p in trainer.model.terms[name].parameters()])
    with torch.no_grad():
        rest = frame.errors()["acceleration"].flatten() - given @ slopes
    matrix, target = (torch.from_numpy(global_sum(comm, part.numpy())) for part in (slopes @ slopes.T, slopes @ rest))
    best = torch.linalg.solve(matrix, -target)
    share = (rest + best @ slopes).square().sum() / (3 * frame.total * frame.acceleration_rms**2)
    least = global_sum(comm, float(share))
    assert -1e-9 < losses[-1] - least < 0.02 * (losses[0] - least)


@pytest.mark.mpi(1, 2)
@pytest.mark.parametrize("preset, cutoff", [("resolved", SUPPORT), ("paper", 0.6 * SUPPORT), ("paper", 1.5 * SUPPORT)])
def test_the_field_loss_reaches_as_far_as_its_kernel_whatever_the_model_sees(comm, preset, cutoff):
    kernel = WendlandC2(SUPPORT)
    frame, expected = (frame_of(comm, model_of(*made, 45, (8, 8))) for made in ((preset, cutoff), ("paper", SUPPORT)))
    found, known = frame.within(kernel), expected.within(kernel)
    own = slice(0, len(frame.particles))
    assert torch.allclose(found.volumes[own], known.volumes[own], rtol=1e-12)
    assert found.neighborhood.cutoff >= SUPPORT


@pytest.mark.mpi(1)
def test_a_model_without_parameters_has_nothing_to_keep_but_its_rates(comm):
    trainer = trainer_of(comm, ("pressure", "pairs"), pairs={"inputs": ("distance", "speed", "approach")})
    kept = trainer.frames[0].kept["pressure"]
    assert not kept.slopes and not kept.parameters and not trainer.model.reads_density
    assert trainer.frames[0].seen().density is None
    assert np.isfinite(row_and_gradient(trainer)[1]).all()


@pytest.mark.mpi(1, 2, 3)
def test_the_error_of_all_losses_is_that_of_the_acceleration_where_nothing_else_has_weight(comm):
    trainer = trainer_of(comm, weights=LossWeights(), batch=10**6)
    frame = trainer.frames[0]
    with torch.no_grad():
        squares = global_sum(comm, float(frame.errors()["acceleration"].square().sum()))
    expected = (squares / (3 * frame.total)) ** 0.5 / frame.acceleration_rms
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
        trainer.model.terms["pairs"].network.biases[-1][0] = torch.nan
    phase = Phase("all losses", np.ones(3), (1e-2, 1e-3), trainer.combined_step,
                  lambda: trainer.combined_error(trainer.frames[0], 2), 1)
    with pytest.raises(TrainingDiverged, match="step 0 of the training .all losses.: loss is nan"):
        Training(comm, trainer.model, [phase]).step()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, counts", [(OWN_DENSITY, False), ("paper", True)])
def test_of_learned_rates_of_density_only_the_paper_s_counts_in_single_frames(comm, preset, counts):
    trainer = trainer_of(comm, preset, LossWeights())
    assert trainer.model.regresses_density == counts
    trainer.trajectory_step(Adam(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0)
    learned = {name: [p.grad is not None and bool(p.grad.any()) for p in term.parameters()]
               for name, term in trainer.model.terms.items()}
    assert any(learned["pairs"]) and any(learned["density-flux"]) == counts
    assert not any(learned.get("continuity", []))


@pytest.mark.mpi(1)
def test_every_loss_has_a_name_that_the_learning_curves_know(comm):
    trainer = trainer_of(comm)
    row = trainer.combined_step(Adam(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0)
    names = {"loss", "trajectory_loss", "field_loss", "velocity_kl_loss", "acceleration_kl_loss", "power_loss"}
    assert set(row) == names | {"gradient_norm"} and names <= {name for name, *_ in LOSSES}
    weighted = row["trajectory_loss"] + sum(weight * row[f"{name}_loss"]
                                            for name, weight in vars(trainer.weights).items())
    assert row["loss"] == pytest.approx(weighted, rel=1e-12)


@pytest.mark.mpi(1, 2)
def test_losses_without_weight_are_not_computed(comm, monkeypatch):
    for name in ("_field_share", "_divergence", "_power_share"):
        monkeypatch.setattr(ForceTrainer, name, lambda *args: pytest.fail("an unused loss was computed"))
    rows = []
    for kind in ("trajectory_step", "combined_step"):
        trainer = trainer_of(comm, weights=LossWeights())
        rows.append(getattr(trainer, kind)(Adam(comm, trainer.model.parameters(), 1, 1e-2, 1e-2), 0))
    assert set(rows[0]) == {"loss", "trajectory_loss", "gradient_norm"}
    # Without the field loss there is no cube: both draw the same batch.
    assert rows[0] == rows[1]


FIELD, SPAN = LossWeights(field=1.0), 0.1


def beside_a_flow(comm, moved=0.0, offset=(0.0, 0.0, 0.0), velocity=None):
    """A trainer whose frame has a filtered field one frame later on a grid of 10^3 points, by then with all particles
    `moved` upwards; the field is the velocity of a wind and an offset, the particles' that of the wind unless given."""
    model = model_of(OWN_DENSITY, SUPPORT, 45, (8, 8))
    frame, wind = frame_of(comm, model), torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    position, points = frame.particles.position, grid_points(frame.decomposition, 10)
    shift = torch.tensor([0.0, 0.0, moved], dtype=torch.float64)
    field = (wind + torch.tensor([offset], dtype=torch.float64)).expand(len(points), 3)
    later = FieldLater(position + shift, wind.expand_as(position) if velocity is None else velocity(position), SPAN,
                       points, field)
    frame.later = later
    return ForceTrainer(model, [frame], WendlandC2(SUPPORT), FIELD, 300, seed=5)


@pytest.mark.mpi(1)
def test_where_the_kernel_is_exact_the_filtered_field_asks_for_what_the_true_particles_do(comm):
    """A uniform velocity is its own average. A field that differs from it by a vector adds as much over the span."""
    trainer = beside_a_flow(comm)
    frame, later = trainer.frames[0], trainer.frames[0].later

    def field_loss(at):
        frame.later, frame._within = at, None
        return row_and_gradient(trainer)

    (beside, gradient), (alone, expected) = field_loss(later), field_loss(None)
    assert beside["field_loss"] == pytest.approx(alone["field_loss"], rel=1e-9)
    assert np.allclose(gradient, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    offset = torch.tensor([[0.03, 0.0, -0.01]], dtype=torch.float64)
    frame.acceleration = frame.acceleration + frame.errors()["acceleration"].detach()  # no error of the force is left
    found = field_loss(replace(later, field=later.field + offset))[0]
    expected = float(offset.square().sum()) / 3 / SPAN**2 / frame.acceleration_rms**2
    assert found["field_loss"] == pytest.approx(expected, rel=1e-9)


@pytest.mark.mpi(2, 3)
def test_the_filtered_field_is_the_same_on_any_number_of_ranks(comm):
    """Also where particles have left their slabs by then."""
    from mpi4py import MPI

    def row_of(communicator):
        return row_and_gradient(beside_a_flow(communicator, 0.1, (0.1, 0.0, 0.0), lambda position: position.sin()))

    (row, gradient), (alone, expected) = row_of(comm), row_of(MPI.COMM_SELF)
    assert row == pytest.approx(alone, rel=1e-9)
    assert np.allclose(gradient, expected, rtol=1e-8, atol=1e-11)


@pytest.mark.mpi(1)
def test_gradient_beside_a_filtered_field_against_finite_differences(comm):
    trainer = beside_a_flow(comm, 0.1, (0.1, 0.0, 0.0))
    gradient = row_and_gradient(trainer)[1]

    def loss():
        recorder = Recorder(comm, trainer.model)
        with torch.enable_grad():
            return trainer.combined_step(recorder, 0)["loss"]

    found, expected = slope(trainer.model, loss, gradient, 1e-6)
    assert found == pytest.approx(expected, rel=1e-5)
