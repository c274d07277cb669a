import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from mpi4py import MPI

from eddies.flow.tracers import release
from eddies.learning.force_training import FieldLater, ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.training import Adam, Phase, Training, TrainingDiverged
from eddies.parallel.reduction import global_sum
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import mean_over_ranks, sum_over_ranks
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
# The pairs read the density of pressure and stress, a part of which is learned.
THROUGH_DENSITY = ("pressure", f"{__name__}:AmplifiedStress", "pairs")


class AmplifiedStress(Stress):
    """The stress with a learned factor."""

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.amplitude = torch.nn.Parameter(torch.ones((), dtype=torch.float64))

    def forward(self, context):
        rates = super().forward(context)
        return Rates(force_modes=self.amplitude * rates.force_modes,
                     pressure_modes=self.amplitude * rates.pressure_modes)


@dataclass(frozen=True, kw_only=True)
class ReadsNothing(TermSettings):
    """Settings of an acceleration that depends on each particle alone."""


class BlurredDrag(Term):
    """-rate times a noisy velocity: the true one plus an independent function of the position."""

    Settings = ReadsNothing
    linear = True

    def __init__(self, settings, flow):
        super().__init__(settings, flow)
        self.rate = torch.nn.Parameter(torch.zeros((), dtype=torch.float64))

    def forward(self, context):
        particles = context.particles
        noise = torch.cos(9 * particles.position.roll(1, dims=1) + particles.position)
        return Rates(acceleration=-self.rate * (particles.velocity + noise))


def frame_of(comm, model, wind=0.0):
    """Particles in a smooth flow plus a wind, accelerated by a pressure gradient and a drag of rate 0.3.

    They have a density if the model integrates one.
    """
    slab = SlabDecomposition(comm, LENGTH, PER_SIDE)
    columns = release(slab, 3, PER_SIDE**3, "random")
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
        dynamics.resolution.iterations = 8  # the same number on any number of ranks
    return TrainingFrame(dynamics, particles, torch.from_numpy(acceleration), rate)


def trainer_of(comm, preset=OWN_DENSITY, weights=ALL, batch=300):
    model = model_of(preset, SUPPORT, 45, (8, 8))
    return ForceTrainer(model, [frame_of(comm, model)], WendlandC2(SUPPORT), weights, batch, seed=5)


def row_and_gradient(trainer, kind="combined_step"):
    recorder = Recorder(trainer.comm, trainer.model)
    return getattr(trainer, kind)(recorder, 0), recorder.gradient


def fitted(trainer, steps, rates, kind="trajectory_step"):
    """The rows of some optimiser steps."""
    optimizer = Adam(trainer.comm, trainer.model.parameters(), steps, *rates)
    return [getattr(trainer, kind)(optimizer, step) for step in range(steps)]


@pytest.mark.mpi(3)
@pytest.mark.parametrize("preset", [OWN_DENSITY, "resolved + pairs", None], ids=["pairs", "resolved", "beside a flow"])
def test_training_is_the_same_on_any_number_of_ranks(comm, preset):
    """Beside a filtered field of the flow, particles leave their slabs until the time of the field."""
    def losses_and_weights(communicator):
        trainer = trainer_of(communicator, preset) if preset else beside_a_flow(
            communicator, 0.1, (0.1, 0.0, 0.0), lambda position: position.sin())
        rows = [row for kind in ("trajectory_step", "combined_step") for row in fitted(trainer, 3, (1e-2, 1e-3), kind)]
        rows.append({"error": trainer.combined_error(trainer.frames[0], draws=3)})
        assert rows[-1]["error"] == trainer.combined_error(trainer.frames[0], draws=3)
        return rows, torch.cat([p.detach().flatten() for p in trainer.model.parameters()])

    (rows, weights), (alone, weights_alone) = losses_and_weights(comm), losses_and_weights(MPI.COMM_SELF)
    for row, other in zip(rows, alone):
        assert row == pytest.approx(other, rel=1e-9)
    assert torch.allclose(weights, weights_alone, rtol=1e-8, atol=1e-11)


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, kind", [("paper", "trajectory_step"), ("resolved + pairs", "trajectory_step"),
                                          (THROUGH_DENSITY, "trajectory_step"), (OWN_DENSITY, "combined_step")])
def test_gradient_against_finite_differences(comm, kind, preset):
    trainer = trainer_of(comm, preset)
    with torch.no_grad():  # initial weights depend little on the density
        trainer.model.terms["pairs"].network.weights[0][:, :2] *= 5
    gradient = row_and_gradient(trainer, kind)[1]

    def loss():
        recorder = Recorder(comm, trainer.model)
        recorder.step = lambda share: 0.0
        return getattr(trainer, kind)(recorder, 0)["loss"]

    found, expected = slope(trainer.model, loss, gradient, 1e-6)
    # The kinks of histograms between bins add to the error of a difference.
    assert found == pytest.approx(expected, rel=1e-3 if kind == "combined_step" else 1e-6)


@pytest.mark.mpi(3)
@pytest.mark.parametrize("preset", ["resolved + pairs", THROUGH_DENSITY])
def test_linear_terms_are_evaluated_once(comm, preset, monkeypatch):
    """Their kept rates give the same losses and gradients, also with other parameters than they were made with."""
    trainer = trainer_of(comm, preset)
    frame, model = trainer.frames[0], trainer.model
    assert frame.kept.keys() == {name for name in model.terms if name != "pairs"}
    with torch.no_grad():
        for parameter in model.parameters():
            parameter *= 1.3
    with monkeypatch.context() as forbidden:
        for name in frame.kept:
            forbidden.setattr(model.terms[name], "forward", lambda context: pytest.fail("evaluated again"))
        row, gradient = row_and_gradient(trainer)
    frame.kept = None
    direct, expected = row_and_gradient(trainer)
    assert row == pytest.approx(direct, rel=1e-11)
    assert np.linalg.norm(gradient - expected) < 1e-10 * np.linalg.norm(expected)


@pytest.mark.mpi(2)
def test_terms_read_the_density_that_is_given(comm):
    frame = trainer_of(comm, THROUGH_DENSITY).frames[0]
    density = frame.seen().density
    same, other, own = (frame.errors(density=each)["acceleration"] for each in (density, 1.01 * density, None))
    assert torch.allclose(same, own, rtol=0, atol=1e-12) and not torch.allclose(other, own, rtol=0, atol=1e-3)


@pytest.mark.mpi(1)
def test_the_loss_of_the_power_corrects_the_attenuation_by_noise(comm):
    """A drag of rate 0.3, fitted to the acceleration with a noisy velocity, takes out too little energy."""
    rates = {}
    for power in (0.0, 1e4):
        trainer = trainer_of(comm, (f"{__name__}:BlurredDrag",), LossWeights(power=power), batch=10**6)
        start = trainer.one_step_error(trainer.frames[0], 10**6)  # holds both losses
        rows = fitted(trainer, 200, (3e-2, 1e-4))
        assert (power > 0) == ("power_loss" in rows[-1]) and start == pytest.approx(rows[0]["loss"] ** 0.5, rel=1e-9)
        rates[power] = float(trainer.model.terms["BlurredDrag"].rate.detach())
    attenuation = 1 / (1 + 0.5 / (0.5 + 0.16 / 6))  # by the variances of a component of the velocity and of its noise
    assert rates[0.0] == pytest.approx(0.3 * attenuation, rel=0.1)
    assert rates[1e4] == pytest.approx(0.3, rel=0.03)
    # A mean velocity does not count.
    windy = frame_of(comm, trainer.model, wind=7.0)
    assert torch.allclose(windy.fluctuation, trainer.frames[0].fluctuation, rtol=0, atol=1e-12)
    # The power of an acceleration u'/t along the velocity is 3 u'^2/t, here in units of u'^3/d with t = d/u'.
    velocity = windy.particles.velocity - 7.0
    velocity -= mean_over_ranks(comm, velocity)
    speed = math.sqrt(float(sum_over_ranks(comm, velocity.square().sum())) / (3 * PER_SIDE**3))
    width = trainer.model.flow.scales.filter_width
    power = float(sum_over_ranks(comm, (windy.fluctuation * velocity * speed / width).sum())) / PER_SIDE**3
    assert power == pytest.approx(3, rel=1e-9)


@pytest.mark.mpi(1)
def test_a_model_without_networks_reaches_the_least_squares_fit(comm):
    """The loss is quadratic in the seven factors of the model."""
    trainer = trainer_of(comm, "resolved", LossWeights(), batch=10**6)
    assert not trainer.model.networks and trainer.frames[0].dynamics.neighborhood is None
    # Nearly all of the velocity is resolved, so the factors that fit are large.
    losses = [row["loss"] for row in fitted(trainer, 600, (1.0, 1e-2))]
    frame = trainer.frames[0]
    slopes = torch.cat([frame.kept[name].slopes["acceleration"] for name in frame.kept if frame.kept[name].slopes])
    slopes = slopes.flatten(1)
    given = torch.cat([p.detach().flatten() for name in frame.kept for p in trainer.model.terms[name].parameters()])
    with torch.no_grad():
        rest = frame.errors()["acceleration"].flatten() - given @ slopes
    best = torch.linalg.solve(slopes @ slopes.T, -slopes @ rest)
    least = float((rest + best @ slopes).square().sum()) / (3 * frame.total * frame.acceleration_rms**2)
    assert -1e-9 < losses[-1] - least < 0.02 * (losses[0] - least)


@pytest.mark.mpi(2)
@pytest.mark.parametrize("preset, cutoff", [("resolved", SUPPORT), ("paper", 0.6 * SUPPORT)])
def test_the_field_loss_reaches_as_far_as_its_kernel(comm, preset, cutoff):
    kernel = WendlandC2(SUPPORT)
    frame, expected = (frame_of(comm, model_of(*made, 45, (8, 8))) for made in ((preset, cutoff), ("paper", SUPPORT)))
    found, own = frame.within(kernel), slice(0, len(frame.particles))
    assert torch.allclose(found.volumes[own], expected.within(kernel).volumes[own], rtol=1e-12)
    assert found.neighborhood.cutoff >= SUPPORT


@pytest.mark.mpi(2)
def test_a_nan_ends_the_training_on_all_ranks(comm):
    """Also on ranks that own no particle of the cube of the step."""
    trainer = trainer_of(comm)
    with torch.no_grad():
        trainer.model.terms["pairs"].network.biases[-1][0] = torch.nan
    phase = Phase("all losses", np.ones(3), (1e-2, 1e-3), trainer.combined_step,
                  lambda: trainer.combined_error(trainer.frames[0], 2), 1)
    with pytest.raises(TrainingDiverged, match="step 1 .*loss is nan"):
        Training(comm, trainer.model, [phase]).step()


@pytest.mark.mpi(1)
@pytest.mark.parametrize("preset, counts", [(OWN_DENSITY, False), ("paper", True)])
def test_single_frames_train_the_density_rate_of_the_paper_only(comm, preset, counts):
    trainer = trainer_of(comm, preset, LossWeights())
    assert trainer.model.regresses_density == counts
    fitted(trainer, 1, (1e-2, 1e-2))
    learned = {name: [p.grad is not None and bool(p.grad.any()) for p in term.parameters()]
               for name, term in trainer.model.terms.items()}
    assert any(learned["pairs"]) and any(learned["density-flux"]) == counts
    assert not any(learned.get("continuity", []))


@pytest.mark.mpi(3)
def test_losses_have_names_and_weights(comm, monkeypatch):
    trainer = trainer_of(comm)
    row, = fitted(trainer, 1, (1e-2, 1e-2), "combined_step")
    names = {"loss", "trajectory_loss", "field_loss", "velocity_kl_loss", "acceleration_kl_loss", "power_loss"}
    assert set(row) == names | {"gradient_norm"} and names <= {name for name, *_ in LOSSES}
    weighted = row["trajectory_loss"] + sum(weight * row[f"{name}_loss"]
                                            for name, weight in vars(trainer.weights).items())
    assert row["loss"] == pytest.approx(weighted, rel=1e-12)
    # Losses without weight are not computed. Without the field loss both steps draw the same batch.
    for name in ("_field_share", "_divergence", "_power_share"):
        monkeypatch.setattr(ForceTrainer, name, lambda *args: pytest.fail("an unused loss was computed"))
    trainer = trainer_of(comm, weights=LossWeights(), batch=10**6)
    frame = trainer.frames[0]
    with torch.no_grad():
        square = global_sum(comm, float(frame.errors()["acceleration"].square().sum())) / (3 * frame.total)
    assert trainer.combined_error(frame, draws=3) == pytest.approx(square**0.5 / frame.acceleration_rms, rel=1e-12)
    rows = [fitted(trainer_of(comm, weights=LossWeights()), 1, (1e-2, 1e-2), kind)[0]
            for kind in ("trajectory_step", "combined_step")]
    assert set(rows[0]) == {"loss", "trajectory_loss", "gradient_norm"} and rows[0] == rows[1]


SPAN = 0.1


def beside_a_flow(comm, moved=0.0, offset=(0.0, 0.0, 0.0), velocity=None):
    """A trainer with the field loss only, whose frame has a filtered field on 10^3 points one frame later.

    By then all particles have `moved` upwards. The field is the velocity of a wind plus an offset; the particles have
    the velocity of the wind unless it is given.
    """
    model = model_of(OWN_DENSITY, SUPPORT, 45, (8, 8))
    frame, wind = frame_of(comm, model), torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    position, points = frame.particles.position, grid_points(frame.decomposition, 10)
    shift = torch.tensor([0.0, 0.0, moved], dtype=torch.float64)
    field = (wind + torch.tensor([offset], dtype=torch.float64)).expand(len(points), 3)
    frame.later = FieldLater(position + shift, wind.expand_as(position) if velocity is None else velocity(position),
                             SPAN, points, field)
    return ForceTrainer(model, [frame], WendlandC2(SUPPORT), LossWeights(field=1.0), 300, seed=5)


@pytest.mark.mpi(1)
def test_a_uniform_filtered_field(comm):
    """The kernel averages it exactly: the loss is that without a field. An offset of the field adds offset / span."""
    trainer = beside_a_flow(comm)
    frame, later = trainer.frames[0], trainer.frames[0].later

    def field_loss(at):
        frame.later, frame._within = at, None
        return row_and_gradient(trainer)

    (beside, gradient), (alone, expected) = field_loss(later), field_loss(None)
    assert beside["field_loss"] == pytest.approx(alone["field_loss"], rel=1e-9)
    assert np.allclose(gradient, expected, rtol=1e-6, atol=1e-9 * np.abs(expected).max())
    offset = torch.tensor([[0.03, 0.0, -0.01]], dtype=torch.float64)
    frame.acceleration = frame.acceleration + frame.errors()["acceleration"].detach()  # the force has no error now
    found = field_loss(replace(later, field=later.field + offset))[0]
    expected = float(offset.square().sum()) / 3 / SPAN**2 / frame.acceleration_rms**2
    assert found["field_loss"] == pytest.approx(expected, rel=1e-9)
