"""Estimates of the memory of a rank, and of the disk space, that the stages of a scene need, in bytes.

The constants were measured with the scenes `tiny` to `hit` on one and two ranks, and with thin slabs of 1024^3 cells.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import NamedTuple

from eddies.cores import threads
from eddies.flow.history import EVERY
from eddies.io.checkpoint import KEPT
from eddies.scene.scene import Flow, Kernel, Scene, Simulation, Tracers, Training
from eddies.scene.sections import RECONSTRUCTED
from eddies.spectral.fourier_passes import BLOCK_BYTES
from eddies.workflows.foreseen.numbers import Estimates, estimate
from eddies.workflows.ground_truth.frame_counts import KERNEL_FIELDS, TESTED_PARTICLES, unfiltered_frames, whole_cells

# Memory of a process that holds no field, without and with torch; memory of a report with its figures.
FLOW_PROCESS, TORCH_PROCESS, REPORT_PROCESS = 100e6, 285e6, 280e6
# Direct simulation of a compressible (True) or incompressible (False) fluid: bytes of a cell in float64, and number of
# work arrays of at least two planes. Bytes of a tracer.
CELL_BYTES, BLOCK_ARRAYS, TRACER_BYTES = {True: 320, False: 220}, {True: 64, False: 32}, 300
# Bytes in the evaluation of a model: per particle, per grid point, and per neighbour in the neighbour lists. Bytes in
# the training of the kernel: per neighbour of a grid point, and per particle in the table of a field.
PARTICLE_BYTES, POINT_BYTES, NEIGHBOR_BYTES, GRADIENT_BYTES, TABLE_BYTES = 800, 160, 8, 200, 1100
# Bytes on disk: of a product without its frames, of a report, and of a row of the statistics without the spectrum.
PRODUCT_BYTES, REPORT_BYTES, SAMPLE_BYTES = 45_000, 10e6, 200


class Storage(NamedTuple):
    """Bytes that a stage needs: memory of the rank that needs the most, and disk space of the stage.

    `kept` is the disk space of the files that the stage leaves in the run directory, None if unknown. `scratch` is that
    of the files that it removes at its end.
    """

    memory: float
    kept: float | None
    scratch: float = 0.0


def storage(scene: Scene, stage: str, ranks: int) -> Storage:
    """Estimate the memory and the disk space that a stage needs."""
    tracers, kernel, model, expected = scene.tracers, scene.kernel, scene.model, estimate(scene)
    if stage == "dns":
        memory = flow_memory(scene.flow, tracers, ranks)
        return Storage(memory, *flow_disk(scene.flow, tracers, scene.simulation, scene.training, expected))
    if stage == "report":
        return Storage(REPORT_PROCESS, REPORT_BYTES)
    if stage == "train-kernel":  # planes of five reconstructions, velocity and gradient
        return Storage(kernel_memory(kernel, tracers, ranks), PRODUCT_BYTES + 80 * tracers.cells**2 + 64 * kernel.steps)
    planes = tracers.planes if scene.needs_resolved_velocity or stage != "train" else 0
    if stage == "reconstruct":
        planes = scene.tracers_resolving.planes
    evaluation = evaluation_memory(tracers, ranks, scene.neighbors if model and "pairs" in model.reads else 0.0,
                                   scene.simulation.skin if scene.simulation else 0.0, planes)
    if stage == "train":         # samples of rates, and the history
        training = scene.own_training
        if scene.training and scene.training.field_weight > 0:
            evaluation += NEIGHBOR_BYTES * kernel.neighbors * tracers.particles / ranks
        frames = training.frames + 2 if training else 1  # each has neighbour lists and a grid
        samples = 48 * min(tracers.particles, TESTED_PARTICLES)
        return Storage(TORCH_PROCESS + frames * evaluation,
                       PRODUCT_BYTES + samples + 100 * (training.steps_in_all if training else 0))
    memory = TORCH_PROCESS + evaluation + (CELL_BYTES[True] * tracers.planes**3 / ranks if scene.coarse_cells else 0.0)
    if stage == "reconstruct":
        settings = scene.reconstruction
        values = sum(RECONSTRUCTED[name] for name in settings.fields) * (settings.cells or tracers.cells) ** 3
        frames = expected.frame_intervals and math.ceil((expected.frame_intervals + 1) / settings.every)
        return Storage(memory, frames and PRODUCT_BYTES + 4 * frames * values)
    if stage == "find-step":
        return Storage(memory, PRODUCT_BYTES)
    return Storage(memory, expected.rollout and rollout_bytes(tracers.particles, expected.rollout.intervals + 1))


def flow_memory(flow: Flow, tracers: Tracers | None, ranks: int) -> float:
    """Return the memory of a rank in the direct simulation."""
    cells, real = flow.cells, flow.real_bytes
    block = BLOCK_ARRAYS[flow.compressible] * max(threads() * BLOCK_BYTES, 2 * cells**2 * real)
    points = cells**2 * math.ceil(cells / ranks)
    size = FLOW_PROCESS + CELL_BYTES[flow.compressible] * real / 8 * points + block
    sets = tracers.all if tracers else ()
    return size + sum(3 * real * points + TRACER_BYTES * each.particles / ranks for each in sets)


def kernel_memory(kernel: Kernel, tracers: Tracers, ranks: int) -> float:
    """Return the memory of a rank in the training of the kernel."""
    points = tracers.cells**3 / ranks
    lists = KERNEL_FIELDS * NEIGHBOR_BYTES * points + GRADIENT_BYTES * min(kernel.points, points)
    return TORCH_PROCESS + KERNEL_FIELDS * TABLE_BYTES * tracers.particles / ranks + lists * kernel.neighbors


def evaluation_memory(tracers: Tracers, ranks: int, neighbors: float, skin: float, planes: int) -> float:
    """Return the memory of a rank in an evaluation of the model.

    `neighbors` is 0 for a model without pairs. `planes` is the number of planes of the grid of the resolved velocity, 0
    for a model without this grid.
    """
    own = tracers.particles / ranks
    size = PARTICLE_BYTES * own + POINT_BYTES * planes**2 * math.ceil(planes / ranks)
    if neighbors:
        ghosts = tracers.particles * tracers.radius_of(neighbors) * (1 + skin) / math.pi if ranks > 1 else 0.0
        size += PARTICLE_BYTES * ghosts + NEIGHBOR_BYTES * neighbors * (1 + skin) ** 3 * own
    return size


def flow_disk(flow: Flow, tracers: Tracers | None, simulation: Simulation | None, training: Training | None,
              expected: Estimates) -> tuple[float | None, float]:
    """Return `kept` and `scratch` of the direct simulation (see `Storage`)."""
    k_max, intervals = flow.largest_wavenumber, expected.frame_intervals
    statistics = (SAMPLE_BYTES + 8 * (math.ceil(math.sqrt(3) * k_max) + 1)) * ((expected.steps or 0) // EVERY)
    state = flow.components * (2 * k_max + 1) ** 2 * (k_max + 1) * 2 * flow.real_bytes
    checkpoints = KEPT * state    # KEPT + 1 exist while one is written; one stays, as `state`
    if tracers is None:
        return state + statistics + 4 * flow.components * flow.cells**3, checkpoints
    during, after = (
        trajectory_bytes(flow, tracers, frames,
                         len(unfiltered_frames(simulation, training, tracers.field_every, frames)))
        for frames in (intervals or 0, (intervals or 0) + 1))
    if tracers.sets:  # each set has the statistics; the run directory has the final fields and no last state
        after += len(tracers.sets) * statistics + 4 * flow.components * flow.cells**3
        state = 0
    return None if intervals is None else state + statistics + after, checkpoints + during


def most_disk(work: Iterable[Storage]) -> float:
    """Return the most disk space that stages need at any moment, if they run one after the other."""
    left = most = 0.0
    for needed in work:
        left += needed.kept or 0.0
        most = max(most, left + needed.scratch)
    return most


def trajectory_bytes(flow: Flow, tracers: Tracers, frames: int, whole: int) -> int:
    """Return the size of the frames of tracers (position, velocity, images of the box and density), of the filtered
    fields, and of the unfiltered states. `whole` is the number of unfiltered states."""
    size = 0
    for each in tracers.all:
        points = (each.cells**3 * math.ceil(frames / each.field_every)
                  + whole_cells(flow.largest_wavenumber) ** 3 * whole)
        size += frames * each.particles * (2 * 24 + 6 + 8 * flow.compressible) + 4 * flow.components * points
    return size


def rollout_bytes(particles: int, frames: int) -> int:
    """Return the size of the frames of a rollout (position, velocity, acceleration and images of the box)."""
    return frames * 42 * particles


def in_units(size: float) -> str:
    """Return a number of bytes as text, such as "1.2 GB"."""
    unit, name = next(((unit, name) for unit, name in ((1e9, "GB"), (1e6, "MB")) if size >= unit), (1e3, "kB"))
    return f"{size / unit:.3g} {name}" if name == "GB" else f"{size / unit:.0f} {name}"
