"""How fast the ranks at hand train a scene's kernel and model, and average with a kernel: optimiser steps and averages
among few particles and among more.

Each rank does so by itself, all at once, as in `particle_probe`; nothing is sent.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from eddies.learning.force_training import ForceTrainer, LossWeights, TrainingFrame
from eddies.learning.kernel_training import KernelLossWeights, KernelSample, KernelTrainer
from eddies.learning.optimization import Adam
from eddies.parallel.broadcast import on_all_ranks
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.particles.devices import prepare_torch
from eddies.particles.dynamics import ParticleDynamics
from eddies.particles.particle_field import ParticleField
from eddies.particles.particle_set import ParticleSet
from eddies.particles.smoothing_kernels import KernelNetwork
from eddies.scene.scene import BOX_LENGTH, Scene, Simulation
from eddies.workflows.foreseen.particle_probe import ITERATIONS, LEAST_SIDE, ProbeError, probed_model

REPEATS = 2


@dataclass(frozen=True)
class Line:
    """Seconds that grow with a size: `call` and for each `unit`, through those of two sizes; neither is negative."""

    call: float
    unit: float

    @classmethod
    def through(cls, few: tuple[float, float], many: tuple[float, float]) -> Line:
        """From (size, seconds) twice; of two equal sizes, all belongs to the call."""
        span = many[0] - few[0]
        unit = max(many[1] - few[1], 0.0) / span if span > 0 else 0.0
        return cls(max(few[1] - few[0] * unit, 0.0), unit)

    def at(self, size: float) -> float:
        """Seconds at a size."""
        return self.call + self.unit * size


@dataclass(frozen=True)
class TrainingSpeed:
    """The speed of the slowest rank at hand, each by its size.

    Parameters
    ----------
    kernel_tables : first sums of a sample, by particles. kernel_step : an optimiser step of the kernel, by particles.
    averages : with a kernel at all particles and on a grid, by particles.
    batch_step : an optimiser step of the model on a batch. combined_step : on all losses, by the particles in and
        around a cube, or on a batch where no loss is of fields; combined_tables : the lists of a frame that it needs
        first, by particles.
    """

    kernel_tables: Line | None = None
    kernel_step: Line | None = None
    averages: Line | None = None
    batch_step: Line | None = None
    combined_step: Line | None = None
    combined_tables: Line | None = None


def probe_training(scene: Scene, comm: Comm, model: bool) -> TrainingSpeed:
    """The speed of the ranks at hand at training the scene's kernel and, if asked for, its `model`; all ranks call
    it. Raises ProbeError, on all ranks, where a term cannot be made or trained."""
    threads, state = torch.get_num_threads(), torch.random.get_rng_state()
    prepare_torch("cpu", comm)
    alone = comm.Split(comm.rank)
    try:
        side = max(LEAST_SIDE, math.ceil(2 * reach_in_spacings(scene)) + 1)
        found = on_all_ranks(comm, lambda: _measured(scene, alone, (side, 2 * side), model), ProbeError)
        slowest = global_max(comm, np.array([seconds for _, seconds in found.values()])).tolist()
        sizes = {name: size for name, (size, _) in found.items()}
        seconds = dict(zip(found, slowest))
        kinds = dict.fromkeys(kind for kind, _ in found)
        return TrainingSpeed(**{kind: Line.through(*((sizes[kind, number], seconds[kind, number]) for number in (0, 1)))
                                for kind in kinds})
    finally:
        alone.Free()
        torch.set_num_threads(threads)
        torch.random.set_rng_state(state)


def reach_in_spacings(scene: Scene) -> float:
    """How far particles see, in units of their mean distance."""
    skin = scene.simulation.skin if scene.simulation else 0.0
    return max((1 + skin) * scene.interaction_radius, scene.kernel_support or 0.0) / scene.tracers.spacing


def evaluated_scene(scene: Scene) -> Scene:
    """The scene where its rollout evaluates the model, or with one that does so as the training does."""
    simulates = scene.simulation is not None and "model" in scene.simulation.needs
    return scene if simulates else trained_scene(scene)


def trained_scene(scene: Scene) -> Scene:
    """The scene with a rollout that evaluates the model as its training does: without skin and forcing, in its
    precision."""
    interval, training = scene.tracers.frame_interval, scene.training
    return replace(scene.without_variants, eulerian=None, simulation=Simulation(
        step=interval, frame_interval=interval, turnovers=1.0, start=0.0, skin=0.0,
        precision=training.precision if training else "float32",
        integrator=training.horizons.integrator if training and training.horizons else "rk3"))


def cube_rows(scene: Scene, side: int) -> float:
    """Particles of `side`^3 in and around a cube of a quarter of the box, as far as the kernel sees."""
    reach = scene.kernel_support / scene.tracers.spacing
    return min(side / 4 + 2 * reach, side) ** 3


def _measured(scene: Scene, alone: Comm, sides: tuple[int, int],
              model: bool) -> dict[tuple[str, int], tuple[float, float]]:
    """Size and seconds of each kind, for few particles and for many."""
    found = {}
    try:
        for number, side in enumerate(sides):
            if scene.kernel:
                found |= {(kind, number): (side**3, seconds)
                          for kind, seconds in _of_kernel(scene, alone, side).items()}
            if model and scene.model.path is None:
                found |= {(kind, number): measured for kind, measured in _of_model(scene, alone, side, number).items()}
    except Exception as error:  # of a term of the user's, anything
        raise ProbeError(f"{type(error).__name__}: {error}") from error
    return found


def _of_kernel(scene: Scene, alone: Comm, side: int) -> dict[str, float]:
    """Seconds of what is done with a kernel among `side`^3 particles."""
    settings, tracers = scene.kernel, scene.tracers
    slab = SlabDecomposition(alone, BOX_LENGTH, max(round(tracers.cells / tracers.particles_per_side * side), 1))
    support = scene.kernel_support * tracers.particles_per_side / side
    position = torch.from_numpy(_positions(side))
    velocity = torch.sin(position[:, [1, 2, 0]])
    field, gradient = torch.zeros(slab.planes**3, 3), torch.zeros(slab.planes**3, 3, 3)
    sample = KernelSample(ParticleField(slab, support, position, velocity), field + 1, gradient + 1)
    network = KernelNetwork(support, settings.hidden, settings.cutoff, scene.seed).to(torch.float32)
    weights = KernelLossWeights(settings.gradient_weight, settings.normalization_weight)
    trainer = KernelTrainer(network, [sample], weights, settings.points, scene.seed)
    optimizer = Adam(alone, network.parameters(), REPEATS, 1e-3, 1e-3)
    first, *steps = _seconds(lambda step: trainer.step(optimizer, step))
    with torch.no_grad():
        kernel = network.table()
        averaged = _seconds(lambda _: _averages(slab, kernel, position, velocity))
    return {"kernel_tables": max(first - min(steps), 0.0), "kernel_step": min(steps), "averages": min(averaged)}


def _averages(slab: SlabDecomposition, kernel, position: torch.Tensor, velocity: torch.Tensor) -> None:
    """What a frame of a rollout is averaged for."""
    field = ParticleField(slab, kernel.support, position, velocity)
    volume = field.volumes(kernel)
    field.at_particles(kernel, volume)
    field.velocity_on_whole_grid(kernel, volume)


def _of_model(scene: Scene, alone: Comm, side: int, number: int) -> dict[str, tuple[float, float]]:
    """Size and seconds of optimiser steps of the model among `side`^3 particles, with a quarter of the batch first."""
    settings, trained = scene.training, trained_scene(scene)
    dtype = getattr(torch, settings.precision)
    model = probed_model(trained, side).to(dtype)
    if next(model.parameters(), None) is None:
        return {}
    slab = SlabDecomposition(alone, BOX_LENGTH, 2 * round(0.875 * side))
    dynamics = ParticleDynamics(slab, model, 0.0, dtype)
    if dynamics.resolution is not None:
        dynamics.resolution.iterations = ITERATIONS
    position = torch.from_numpy(_positions(side))
    velocity = torch.sin(position[:, [1, 2, 0]])
    density = torch.ones(len(position), dtype=torch.float64) if model.integrates_density else None
    frame = TrainingFrame(dynamics, ParticleSet(torch.arange(len(position)), position, velocity, density),
                          velocity.to(dtype), torch.ones(len(position), dtype=dtype))
    kernel = None
    if settings.field_weight > 0:
        support = scene.kernel_support * scene.tracers.particles_per_side / side
        with torch.no_grad():
            kernel = KernelNetwork(support, scene.kernel.hidden, scene.kernel.cutoff).to(torch.float32).table()
    weights = LossWeights(settings.field_weight, settings.velocity_kl_weight, settings.acceleration_kl_weight,
                          settings.power_weight)
    batch = max(min(settings.batch, LEAST_SIDE**3) // (4 if number == 0 else 1), 1)
    trainer = ForceTrainer(model, [frame], kernel, weights, batch, scene.seed)
    optimizer = Adam(alone, model.parameters(), 2 * (1 + REPEATS), 1e-6, 1e-6)
    found = {"batch_step": (batch, min(_seconds(lambda step: trainer.trajectory_step(optimizer, step))[1:]))}
    if settings.combined_steps:
        size = cube_rows(scene, side) if kernel is not None else batch
        first, *steps = _seconds(lambda step: trainer.combined_step(optimizer, step))
        found["combined_step"] = size, min(steps)
        found["combined_tables"] = side**3, max(first - min(steps), 0.0)
    return found


def _positions(side: int) -> np.ndarray:
    return np.random.default_rng(4).uniform(0, BOX_LENGTH, (side**3, 3))


def _seconds(work: Callable[[int], object]) -> list[float]:
    """Of a first time, which plans and fills tables, and of REPEATS more."""
    found = []
    for step in range(1 + REPEATS):
        began = time.perf_counter()
        work(step)
        found.append(time.perf_counter() - began)
    return found
