"""The training data of a model: frames and windows of ground truths, each in the units of its flow.

A ground truth is that of the run itself, or one that [training] truths names.
"""

import logging
import math
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from eddies.analysis.lagrangian import evenly
from eddies.clock import ProgressLine
from eddies.errors import UserError
from eddies.io.hdf5 import File, open_product
from eddies.learning.force_training import FieldLater, ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.rollout_training import RolloutTrainer, TrainingWindow
from eddies.parallel.communicator import Comm
from eddies.parallel.migration import migrate
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.exchanges import mean_over_ranks
from eddies.particles.integrators import INTEGRATORS
from eddies.particles.model import LagrangianModel
from eddies.particles.particle_field import grid_points
from eddies.particles.particle_set import ParticleSet
from eddies.particles.periodic_box import PeriodicBox
from eddies.particles.resolved_velocity import ResolvedVelocity
from eddies.particles.smoothing_kernels import SmoothingKernel
from eddies.scene.rules import quoted
from eddies.scene.scene import BOX_LENGTH, Tracers, Training
from eddies.workflows.ground_truth.frame_counts import last_seen, last_trained_on, trained_frames
from eddies.workflows.ground_truth.truth import GroundTruth, open_truth
from eddies.workflows.learned.model import initial_model, particles_for
from eddies.workflows.learned.source import ModelDefinition

log = logging.getLogger("eddies")


class TrainingData:
    """A model in the units of a ground truth, with the frames and windows of this ground truth for training and
    validation.

    `last` is the last frame of the training window. `learned` is the last frame that is trained on; later frames up to
    `last` are for validation.

    Parameters
    ----------
    definition, settings : the definition of the model, and [training].
    truth : the ground truth, of this run or another.
    count : number of frames for training, and also number of windows.
    like : a model with which the parameters are shared; None for new parameters.
    """

    def __init__(self, definition: ModelDefinition, settings: Training, truth: GroundTruth, count: int,
                 like: LagrangianModel | None = None) -> None:
        self.definition, self.settings, self.truth, self.count = definition, settings, truth, count
        self.dtype = getattr(torch, settings.precision)
        self.model = model_for(definition, truth, self.dtype, like)
        self.longest = settings.longest_horizon
        self.last = last_seen(settings.window, len(truth.times))
        self.learned = last_trained_on(settings, len(truth.times))
        self.usable, self.held_out = trained_frames(settings, len(truth.times), truth.field_frames)

    @cached_property
    def frames(self) -> list[TrainingFrame]:
        """The single frames for training; the first use is collective."""
        seen = np.array(self.usable)[evenly(len(self.usable), self.count)]
        progress, frames = ProgressLine("train", lambda: "prepared", unit="frame"), []
        for index in seen:
            frames.append(self._frame(index))
            progress(len(frames) / len(seen), len(frames))
        return frames

    def force_trainer(self, kernel: SmoothingKernel | None) -> ForceTrainer:
        """Return the trainer on single frames. The `kernel` is needed for the field loss."""
        settings = self.settings
        weights = LossWeights(settings.field_weight, settings.velocity_kl_weight, settings.acceleration_kl_weight,
                              settings.power_weight)
        return ForceTrainer(self.model, self.frames, kernel, weights, settings.batch, self.definition.seed)

    def validation_frame(self) -> TrainingFrame:
        """Return the last held-out frame of the training window; collective."""
        return self._frame(self.held_out)

    def rollout_trainer(self) -> tuple[RolloutTrainer, TrainingWindow]:
        """Return the trainer on windows of frames, and the window for validation; collective."""
        settings, slab = self.settings.horizons, self.truth.decomposition
        interval = self.definition.tracers.frame_interval
        dynamics = ParticleDynamics(slab, self.model, 0.0, self.dtype)
        resolution = dynamics.resolution
        if resolution is None and settings.energy_weight > 0:
            resolution = ResolvedVelocity.on_slabs(slab, self.model.flow.scales, dtype=self.dtype)
        if resolution is not None:
            # Gradients neglect that the predicted start of a solve depends on earlier states. Therefore the start must
            # not affect the solution, and the tolerance is the usual one.
            resolution.tolerance_predicted = resolution.tolerance
        starts = evenly(self.learned - self.longest + 1, self.count)
        windows = [self._window(start, resolution) for start in starts]
        substeps = round(interval / (settings.time_step or interval))
        trainer = RolloutTrainer(slab.comm, INTEGRATORS[settings.integrator](dynamics), windows, interval,
                                 substeps, settings.energy_weight, resolution, self.definition.seed)
        return trainer, self._window(self.last - self.longest, resolution)

    def _frame(self, index: int) -> TrainingFrame:
        return load_frame(self.truth, index, self.model, self.dtype, self.settings.wants_fields)

    def _window(self, start: int, resolution: ResolvedVelocity | None) -> TrainingWindow:
        columns, device = self.truth.window(start, self.longest), self.truth.device
        later = {name: torch.from_numpy(columns[f"{name}_later"]).to(device).movedim(1, 0).contiguous()
                 for name in ("position", "velocity", "density") if f"{name}_later" in columns}
        particles = particles_for(self.model, columns, device)
        # Relative to the mean velocity, single precision holds the fluctuations of a fast flow, too.
        mean = mean_over_ranks(self.truth.decomposition.comm, particles.velocity)
        elapsed = torch.from_numpy(np.diff(self.truth.times[start:start + self.longest + 1]).cumsum()).to(mean)
        particles = replace(particles, velocity=particles.velocity - mean)
        later |= {"position": later["position"] - elapsed[:, None, None] * mean, "velocity": later["velocity"] - mean}
        true, unforced = None, None
        if self.settings.horizons.energy_weight > 0:
            # Stored positions are wrapped into the box; `position` continues from the first frame.
            position = particles.position + PeriodicBox(BOX_LENGTH).displacement(later["position"], particles.position)
            straight = particles.position + elapsed[:, None, None] * particles.velocity
            true, unforced = (self._energies(resolution, particles, *moments) for moments in (
                (position, later["velocity"]), (straight, particles.velocity.expand_as(straight))))
        return TrainingWindow(particles, later["velocity"], later.get("density"), true, unforced)

    @torch.no_grad()
    def _energies(self, resolution: ResolvedVelocity, particles: ParticleSet, position: Tensor,
                  velocity: Tensor) -> Tensor:
        """Return the energies (frames, bands) of particles with these positions and velocities (frames, n, 3)."""
        return torch.stack([resolution.band_energies(ParticleSet(particles.id, *moved))
                            for moved in zip(position, velocity)])


def model_for(definition: ModelDefinition, truth: GroundTruth, dtype: torch.dtype,
              like: LagrangianModel | None = None) -> LagrangianModel:
    """Return the model in the units of a ground truth, with the forcing of its flow.

    The model has initial parameters, or shares those of the model `like`.
    """
    model = initial_model(definition, truth.scales, truth.decomposition.comm).to(dtype=dtype, device=truth.device)
    if like is not None:
        model.share_parameters(like)
    return model.forced(truth.forcing)


def training_data(definition: ModelDefinition, settings: Training, truths: Sequence[GroundTruth]) -> list[TrainingData]:
    """Return the training data of each ground truth. All of them share one set of parameters. The number of frames for
    training is divided evenly among them."""
    data: list[TrainingData] = []
    for number, truth in enumerate(truths):
        count = len(range(number, settings.frames, len(truths)))
        data.append(TrainingData(definition, settings, truth, count, data[0].model if data else None))
    return data


def load_frame(truth: GroundTruth, index: int, model: LagrangianModel, dtype: torch.dtype,
               with_field: bool = False) -> TrainingFrame:
    """Load a frame with its true rates and, if `with_field`, the filtered field one frame later; collective.

    The particles have the true density if the model integrates the density.
    """
    columns = truth.particles_with_rates(int(index))
    rates = {name: torch.from_numpy(columns[name]).to(truth.device, dtype)
             for name in ("acceleration", "density_rate") if name in columns}
    dynamics = ParticleDynamics(truth.decomposition, model, skin=0.0, dtype=dtype)
    later = _field_after(truth, int(index), dtype) if with_field else None
    frame = TrainingFrame(dynamics, particles_for(model, columns, truth.device), rates["acceleration"],
                          rates.get("density_rate"), later)
    solves = [] if dynamics.resolution is None else dynamics.resolution.solves
    for iterations, residual, converged in solves:
        if not converged and truth.decomposition.comm.rank == 0:
            log.warning("frame %d: a solve for the resolved velocity did not converge in %d iterations, but the result "
                        "is used; its residual is %.1e", index, iterations, residual)
    return frame


def _field_after(truth: GroundTruth, frame: int, dtype: torch.dtype) -> FieldLater:
    """Return the filtered field one frame after `frame`, with the positions and velocities of the particles at that
    time. Both velocities are relative to the mean over the particles."""
    slab, device = truth.decomposition, truth.device
    columns = migrate(slab, truth.window(frame, 1))  # rows as in `particles_with_rates`
    position, later = (torch.from_numpy(columns[name]) for name in ("position", "position_later"))
    # Stored positions are wrapped into the box; `moved` continues from the positions of the frame.
    moved = position + PeriodicBox(slab.length).displacement(later[:, 0], position)
    points = grid_points(slab, truth.fields.cells)
    field, velocity = (torch.from_numpy(values)
                       for values in (truth.field_at(frame + 1, points), columns["velocity_later"][:, 0]))
    mean = mean_over_ranks(slab.comm, velocity)
    return FieldLater(moved.to(device), (velocity - mean).to(device, dtype),
                      float(truth.times[frame + 1] - truth.times[frame - 1]), points.to(device),
                      (field - mean).to(device, dtype))


@contextmanager
def open_truths(own_file: Path, named: Sequence[Path], comm: Comm,
                device: torch.device) -> Iterator[tuple[GroundTruth, list[GroundTruth]]]:
    """Open the ground truth of a run, and those for training, whose files are `named`; collective.

    Yields the ground truth of the run, and the list of the ground truths for training. If `named` is empty, this list
    holds the ground truth of the run.
    """
    with ExitStack() as files:
        own = files.enter_context(open_truth(comm, own_file, device))
        yield own, [own if path.resolve() == own_file.resolve() else files.enter_context(open_truth(comm, path, device))
                    for path in named or (own_file,)]


def truth_problems(settings: Training, tracers: Tracers, reads: Collection[str], own_file: Path,
                   comm: Comm) -> list[str]:
    """Return the reasons why [training] truths cannot be used with terms that read the inputs `reads`. Collective.

    Each reason is one line. The file of the run's own ground truth, `own_file`, is not examined: it may not exist yet.
    """
    own, problems, seen = own_file.resolve(), [], set()
    for name, path in zip(settings.truths or (), settings.truth_files):
        place, file = f"[training] truths: {quoted(name)}", path.resolve()
        if file in seen:
            problems.append(f"{place}: is named twice; name each ground truth once")
        elif file != own:
            try:
                with open_product(comm, path, "ground_truth") as opened:
                    found = _problems_of(opened, settings, tracers, reads, comm)
                    problems += [f"{place}: {problem}" for problem in found]
            except UserError as error:
                problems.append(f"{place}: {error}")
        seen.add(file)
    return problems


def _problems_of(file: File, settings: Training, tracers: Tracers, reads: Collection[str],
                 comm: Comm) -> Iterator[str]:
    """Yield the reasons why an open ground truth of another run does not fit [training], [tracers] and the inputs
    `reads`."""
    if "particles/tracers" not in file:
        yield "holds no tracers to learn from; give the run of a scene with [tracers]"
        return
    truth = GroundTruth(file, comm)
    scales = truth.scales
    own_ratio, other_ratio = tracers.filter_width / tracers.spacing, scales.filter_width / scales.spacing
    if not math.isclose(own_ratio, other_ratio, rel_tol=1e-6):
        yield (f"its filter is {other_ratio:.9g} mean spacings wide, but [tracers] filter_width = "
               f"{tracers.filter_width:.9g} is {own_ratio:.9g} mean spacings; give another run, or set filter_width = "
               f"{other_ratio * tracers.spacing:.9g}")
    if "density" in reads and not truth.has_density:
        yield ("holds no density, which the terms of [model] read; give a run of a compressible flow, or remove these "
               "terms")
    if settings.batch > truth.total:
        yield f"holds {truth.total} particles, fewer than [training] batch = {settings.batch}; lower batch"
    if settings.field_weight > 0 and not math.isclose(tracers.spacing, scales.spacing, rel_tol=1e-6):
        yield (f"its particles have a mean spacing of {scales.spacing:.4g}, but [training] field_weight = "
               f"{settings.field_weight:g} needs the spacing of the kernel, {tracers.spacing:.4g}; remove "
               "field_weight, or give another run")
    interval = float(truth.times[1] - truth.times[0])
    if settings.horizons and not math.isclose(tracers.frame_interval, interval, rel_tol=1e-6):
        yield (f"its frames are {interval:.6g} apart, but [training.horizons] counts frames of [tracers] "
               f"frame_interval = {tracers.frame_interval:g}; make both equal, or remove [training.horizons]")
    trained_frames(settings, len(truth.times), truth.field_frames)
