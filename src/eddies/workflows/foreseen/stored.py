"""Bytes that the stages of a scene leave in its run directory, and those that they need there while they run."""

from __future__ import annotations

import math

from eddies.io.checkpoint import KEPT
from eddies.io.hdf5 import stored_bytes
from eddies.scene.scene import Scene
from eddies.workflows.foreseen.cost_model import real_bytes
from eddies.workflows.foreseen.estimates import flow_steps, largest_wavenumber, tracer_intervals
from eddies.workflows.foreseen.rollout_course import RolloutCourse, rollout_course
from eddies.workflows.ground_truth.frame_counts import whole_cells, whole_frames

CHECKPOINTS = KEPT + 1       # with the one that is being written
# Of the statistics: steps between two samples, numbers in each beside the spectrum.
SAMPLE_EVERY, SAMPLE_COLUMNS = 4, 25
SAMPLES = 20_000             # particles of which a model's rates are kept, 48 bytes each
PRODUCT_BYTES = 45_000       # of a product beside what grows: the scene, headers, words on datasets, small tables
FIGURE_BYTES = 0.6e6         # of a figure of a report, in its page too


def product_bytes(scene: Scene) -> dict[str, int]:
    """Of the products that grow with a run, by stage, as far as they are foreseen."""
    course = rollout_course(scene) if scene.simulation else None
    found = {"dns": ground_truth_bytes(scene), "simulate": rollout_bytes(scene, course) if course else None}
    return {stage: size for stage, size in found.items() if size is not None}


def ground_truth_bytes(scene: Scene) -> int | None:
    """Of ground_truth.h5; None where its number of frames is not foreseen."""
    density = 1 if scene.flow.compressible else 0
    if scene.tracers is None:
        return statistics_bytes(scene) + stored_bytes((3, *[scene.flow.cells] * 3), "f4") + density * stored_bytes(
            (1, *[scene.flow.cells] * 3), "f4")
    intervals = tracer_intervals(scene)
    if intervals is None:
        return None
    return statistics_bytes(scene) + trajectory_bytes(scene, intervals + 1)


def trajectory_bytes(scene: Scene, frames: int) -> int:
    """Of so many frames of tracers with the filtered fields."""
    tracers, density = scene.tracers, 1 if scene.flow.compressible else 0
    points, particles = [tracers.cells] * 3, tracers.particles
    frame = (2 * stored_bytes((particles, 3), "f8") + density * stored_bytes((particles,), "f8")
             + stored_bytes((particles, 3), "i2"))
    field, whole = (stored_bytes((3, *grid), "f4") + density * stored_bytes((1, *grid), "f4")
                    for grid in (points, [whole_cells(largest_wavenumber(scene))] * 3))
    return (8 * particles + frames * frame + math.ceil(frames / tracers.field_every) * field
            + len(whole_frames(scene, frames)) * whole)


def statistics_bytes(scene: Scene) -> int:
    """Of the statistics and their spectra."""
    shells = math.ceil(math.sqrt(3) * largest_wavenumber(scene)) + 1
    return 8 * (SAMPLE_COLUMNS + shells) * (sum(flow_steps(scene) or (0, 0)) // SAMPLE_EVERY)


def flow_scratch_bytes(scene: Scene) -> int:
    """What a direct simulation keeps until it ends: the frames so far, and checkpoints."""
    modes = 2 * largest_wavenumber(scene) + 1
    state = (4 if scene.flow.compressible else 3) * modes**2 * (largest_wavenumber(scene) + 1) * 2 * real_bytes(scene)
    frames = trajectory_bytes(scene, tracer_intervals(scene) or 0) if scene.tracers else 0
    return frames + CHECKPOINTS * state


def kernel_bytes(scene: Scene) -> int:
    """Of kernel.h5: mostly the planes of five reconstructions, velocity and gradient."""
    return PRODUCT_BYTES + 8 * (10 * scene.tracers.cells**2 + 8 * scene.kernel.steps)


def model_bytes(scene: Scene) -> int:
    """Of model.h5: mostly samples of rates and the history."""
    training = scene.training
    steps = 0 if training is None else training.steps
    if training and training.horizons:
        steps += training.horizons.steps * len(training.horizons.frames)
    return PRODUCT_BYTES + 48 * min(scene.tracers.particles, SAMPLES) + 100 * steps


def rollout_bytes(scene: Scene, course: RolloutCourse) -> int:
    """Of rollout.h5: frames of the model."""
    particles = scene.tracers.particles
    frame = 3 * stored_bytes((particles, 3), "f4") + stored_bytes((particles, 3), "i2")
    if stores_density(scene):
        frame += stored_bytes((particles,), "f4")
    return 8 * particles + (course.intervals + 1) * frame


def stores_density(scene: Scene) -> bool:
    """Whether the frames of a rollout have a density."""
    if scene.simulation.on_grid:
        return scene.eulerian is not None and scene.eulerian.compressible
    return scene.flow.compressible and ("density" in scene.simulation.needs or "model" in scene.simulation.needs
                                        and "density" in scene.model.reads)


def true_frames(scene: Scene, course: RolloutCourse) -> int:
    """Frames of a rollout at whose times there is a ground truth."""
    start = scene.seen_in(scene.directory) if scene.simulation.start is None else scene.simulation.start
    left = (1 - start) * scene.tracers.turnovers * course.turnover_time
    return min(course.intervals, int(left / course.interval)) + 1
