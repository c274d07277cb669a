"""Memory of a rank and disk that the stages of a scene need, in bytes. The constants were measured with `tiny` to `hit`
on one and two ranks, and with thin slabs of 1024^3 cells."""

from __future__ import annotations

import math
from collections.abc import Iterable

from eddies.cores import threads
from eddies.flow.history import EVERY
from eddies.io.checkpoint import KEPT
from eddies.scene.scene import Scene
from eddies.spectral.fourier_passes import BLOCK_BYTES
from eddies.workflows.foreseen.numbers import Rollout, flow_steps, largest_wavenumber, rollout_of, tracer_intervals
from eddies.workflows.ground_truth.frame_counts import (KERNEL_FIELDS, TESTED_PARTICLES, whole_cells,
                                                        whole_frames)

# A process before any field, without and with torch; a report with its figures.
FLOW_PROCESS, TORCH_PROCESS, REPORT_PROCESS = 100e6, 285e6, 280e6
# Direct simulation: a cell in float64, and the arrays of two planes that are worked on, by whether the fluid is
# compressible; a tracer.
CELL_BYTES, BLOCK_ARRAYS, TRACER_BYTES = {True: 320, False: 220}, {True: 64, False: 32}, 300
# Evaluation of a model: a particle, a point of its grid, a listed neighbour. Training of the kernel: a neighbour of a
# grid point, a particle in the table of a field.
PARTICLE_BYTES, POINT_BYTES, NEIGHBOR_BYTES, GRADIENT_BYTES, TABLE_BYTES = 800, 160, 8, 200, 1100
# Disk: a product without its frames, a report, a row of the statistics without the spectrum.
PRODUCT_BYTES, REPORT_BYTES, SAMPLE_BYTES = 45_000, 10e6, 200


def memory(scene: Scene, stage: str, ranks: int) -> float:
    """Memory of the rank that needs most."""
    if stage in ("dns", "report"):
        return flow_memory(scene, ranks) if stage == "dns" else REPORT_PROCESS
    tracers, kernel, training = scene.tracers, scene.kernel, scene.training
    own, planes = tracers.particles / ranks, tracers.planes
    if stage == "train-kernel":
        points = tracers.cells**3 / ranks
        lists = KERNEL_FIELDS * NEIGHBOR_BYTES * points + GRADIENT_BYTES * min(kernel.points, points)
        return TORCH_PROCESS + KERNEL_FIELDS * TABLE_BYTES * own + lists * kernel.neighbors
    skin, evaluation = scene.simulation.skin if scene.simulation else 0.0, PARTICLE_BYTES * own
    if scene.resolves or stage != "train":
        evaluation += POINT_BYTES * planes**2 * math.ceil(planes / ranks)
    if scene.model and "pairs" in scene.model.reads:
        ghosts = tracers.particles * scene.interaction_radius * (1 + skin) / math.pi if ranks > 1 else 0.0
        evaluation += PARTICLE_BYTES * ghosts + NEIGHBOR_BYTES * scene.neighbors * (1 + skin) ** 3 * own
    if stage != "train":
        coarse = CELL_BYTES[True] * planes**3 / ranks if scene.simulation.on_grid else 0.0
        return TORCH_PROCESS + evaluation + coarse
    if training and training.field_weight > 0:
        evaluation += NEIGHBOR_BYTES * kernel.neighbors * own
    frames = training.frames + 2 if training and scene.model.path is None else 1  # each with lists and a grid
    return TORCH_PROCESS + frames * evaluation


def flow_memory(scene: Scene, ranks: int) -> float:
    """Memory of a rank in the direct simulation."""
    fluid, cells, real = scene.flow.compressible, scene.flow.cells, real_bytes(scene)
    block = BLOCK_ARRAYS[fluid] * max(threads() * BLOCK_BYTES, 2 * cells**2 * real)
    points = cells**2 * math.ceil(cells / ranks)
    size = FLOW_PROCESS + CELL_BYTES[fluid] * real / 8 * points + block
    return size + (3 * real * points + TRACER_BYTES * scene.tracers.particles / ranks if scene.tracers else 0.0)


def disk(scene: Scene, stage: str) -> float | None:
    """Size of what a stage leaves in the run directory; None where the number of its frames is unknown."""
    if stage == "dns":
        intervals, steps = tracer_intervals(scene), flow_steps(scene) or 0
        shells = math.ceil(math.sqrt(3) * largest_wavenumber(scene)) + 1
        statistics = (SAMPLE_BYTES + 8 * shells) * (steps // EVERY)
        if scene.tracers is None:
            return statistics + 4 * fields(scene) * scene.flow.cells**3
        return None if intervals is None else statistics + trajectory_bytes(scene, intervals + 1)
    if stage == "train-kernel":  # planes of five reconstructions, velocity and gradient
        return PRODUCT_BYTES + 80 * scene.tracers.cells**2 + 64 * scene.kernel.steps
    if stage == "train":         # samples of rates, and the history
        return PRODUCT_BYTES + 48 * min(scene.tracers.particles, TESTED_PARTICLES) + 100 * training_steps(scene)
    if stage == "simulate":
        rollout = rollout_of(scene)
        return rollout and rollout_bytes(scene, rollout)
    return PRODUCT_BYTES if stage == "find-step" else REPORT_BYTES


def scratch(scene: Scene) -> float:
    """Disk that a direct simulation needs until it ends: frames, and checkpoints with the one that is written."""
    k_max, intervals = largest_wavenumber(scene), tracer_intervals(scene) or 0
    state = fields(scene) * (2 * k_max + 1) ** 2 * (k_max + 1) * 2 * real_bytes(scene)
    return (KEPT + 1) * state + (trajectory_bytes(scene, intervals) if scene.tracers else 0)


def most_disk(work: Iterable[tuple[Scene, str]]) -> float:
    """The disk that stages of scenes, one after the other, need at the worst moment."""
    left = most = 0.0
    for scene, stage in work:
        left += disk(scene, stage) or 0.0
        most = max(most, left + (scratch(scene) if stage == "dns" else 0.0))
    return most


def trajectory_bytes(scene: Scene, frames: int) -> int:
    """Size of frames of tracers (position, velocity, images of the box and density) and of filtered fields."""
    tracers = scene.tracers
    stored = whole_frames(scene.simulation, scene.training, tracers.field_every, frames)
    whole = whole_cells(largest_wavenumber(scene)) ** 3 * len(stored)
    points = tracers.cells**3 * math.ceil(frames / tracers.field_every) + whole
    return frames * tracers.particles * (2 * 24 + 6 + 8 * scene.flow.compressible) + 4 * fields(scene) * points


def rollout_bytes(scene: Scene, rollout: Rollout) -> float:
    """Size of rollout.h5: frames of the model (position, velocity, acceleration and images of the box)."""
    return (rollout.intervals + 1) * 42 * scene.tracers.particles


def training_steps(scene: Scene) -> int:
    """Optimiser steps of the training of the model."""
    training = scene.training if scene.model.path is None else None
    horizons = training and training.horizons
    return (training.steps if training else 0) + (horizons.steps * len(horizons.frames) if horizons else 0)


def fields(scene: Scene) -> int:
    """Components of the state of the direct simulation."""
    return 4 if scene.flow.compressible else 3


def real_bytes(scene: Scene) -> int:
    """Bytes of a real number on the grid of the direct simulation."""
    return 4 if scene.flow.precision == "float32" else 8


def in_units(size: float) -> str:
    """Bytes as text, such as "1.2 GB"."""
    unit, name = next(((unit, name) for unit, name in ((1e9, "GB"), (1e6, "MB")) if size >= unit), (1e3, "kB"))
    return f"{size / unit:.3g} {name}" if name == "GB" else f"{size / unit:.0f} {name}"
