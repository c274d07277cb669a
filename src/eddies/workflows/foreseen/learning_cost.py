"""Time, memory and disk of what is learned and of what moves by it: kernel, model, rollout."""

from __future__ import annotations

from dataclasses import replace

from eddies.kernels.library import threads
from eddies.particles.smoothing_kernels import KNOTS
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.foreseen.coarse_probe import coarse_scene
from eddies.workflows.foreseen.cost_model import busiest_cells, cost, flow_bytes
from eddies.workflows.foreseen.particle_cost import NEIGHBOR_BYTES, PROCESS_BYTES, particle_bytes, particle_cost
from eddies.workflows.foreseen.particle_work import ParticleWork, particle_work
from eddies.workflows.foreseen.rollout_course import rollout_course
from eddies.workflows.foreseen.stage_cost import FILE_BYTES_PER_SECOND, START_SECONDS, Speeds, StageCost
from eddies.workflows.foreseen.stored import kernel_bytes, model_bytes, rollout_bytes
from eddies.workflows.foreseen.training_probe import cube_rows, evaluated_scene, trained_scene
from eddies.workflows.learned.a_priori import EVALUATIONS as TESTED_FRAMES
from eddies.workflows.learned.training_data import COMBINED_DRAWS, VALIDATION_PARTICLES
from eddies.workflows.learned.training_phases import HORIZON_VALIDATIONS, VALIDATIONS

SAMPLES = 4                  # fields that a kernel is trained on, one more is compared with
# Seconds in which torch is loaded, what draws the curves, and torch's checkpointing; of tiny on one idle rank.
TORCH_SECONDS, CURVES_SECONDS, CHECKPOINTING_SECONDS = 1.3, 2.0, 4.0
# Iterations of a solve for the resolved velocity: that starts from nothing; that starts from what is foreseen and goes
# to the same tolerance, as in a training through horizons; of its gradient. Of tiny to hit, 20 to 40, 1 to 7, 18 to 22.
COLD, FORESEEN, ADJOINT = 25.0, 4.0, 20.0
# Of a loss without its gradient over that of an optimiser step; of the sums of an evaluation with theirs, made once
# forth, once more on the way back, and differentiated (docs/performance.md: 2.3 to 2.6 times).
LOSS_ALONE, WITH_GRADIENT = 0.6, 4.5
# Of a particle or a grid point in a sample of the kernel; of a pair of a grid point while its gradient is taken; of a
# particle of a training frame beside what an evaluation keeps; of one while a frame of a rollout is stored.
SAMPLE_BYTES, PAIR_BYTES, FRAME_BYTES, STORED_BYTES = 64, 200, 64, 400


def kernel_cost(scene: Scene, ranks: int, speeds: Speeds) -> StageCost:
    """Of the kernel: trained twice, with the gradient in the loss and without, on grid points among all particles; and
    compared with two others."""
    settings, tracers, speed = scene.kernel, scene.tracers, speeds.training
    own, points = tracers.particles / ranks, tracers.cells**3 / ranks
    parts = {"start": START_SECONDS + TORCH_SECONDS, "tables": SAMPLES * speed.kernel_tables.at(own),
             "steps": 2 * settings.steps * speed.kernel_step.at(own), "averages": 4 * speed.averages.at(own)}
    tables = 8 * KNOTS * own
    lists = NEIGHBOR_BYTES * settings.neighbors * points
    memory = (PROCESS_BYTES + SAMPLES * (tables + lists)
              + (SAMPLES + 1) * SAMPLE_BYTES * (own + points)
              + PAIR_BYTES * settings.neighbors * min(settings.points, points))
    return StageCost("train-kernel", parts, memory, kernel_bytes(scene))


def training_cost(scene: Scene, ranks: int, speeds: Speeds) -> StageCost:
    """Of the model: frames and their test solve for the resolved velocity from nothing, then come steps."""
    parts = {"start": START_SECONDS + CURVES_SECONDS + (0.0 if scene.kernel else TORCH_SECONDS)}
    work, memory = particle_work(evaluated_scene(scene)), PROCESS_BYTES
    frame = evaluation_seconds(scene, work, ranks, speeds, COLD)
    # With a density that terms give, its rate is tested by the frames before and after.
    tests = 3 if {"density"} <= scene.model.gives and "density" in scene.model.reads else 1
    parts["test"] = tests * TESTED_FRAMES * frame
    if scene.model.path is None:
        work = particle_work(trained_scene(scene))
        parts |= {"frames": (scene.training.frames + 1) * frame, **one_step_seconds(scene, ranks, speeds),
                  **horizon_seconds(scene, work, ranks, speeds)}
        memory += (scene.training.frames + 1) * frame_bytes(scene, work, ranks, speeds)
    memory += frame_bytes(scene, work, ranks, speeds)
    return StageCost("train", parts, memory, model_bytes(scene))


def one_step_seconds(scene: Scene, ranks: int, speeds: Speeds) -> dict[str, float]:
    """Seconds of the optimiser steps on single frames, and of their validations."""
    settings, speed = scene.training, speeds.training
    if speed.batch_step is None:  # no parameters
        return {}
    alone, own = settings.steps - settings.combined_steps, scene.tracers.particles / ranks
    checked = min(VALIDATION_PARTICLES, scene.tracers.particles)
    parts = {"steps": alone * speed.batch_step.at(settings.batch / ranks), "validation": min(alone, VALIDATIONS + 1)
             * LOSS_ALONE * speed.batch_step.at(checked / ranks)}
    if settings.combined_steps:
        rows, tables = settings.batch / ranks, 0.0
        if settings.field_weight > 0:
            # A cube lies within few slabs: the busiest rank has what fits into its own.
            width = min(BOX_LENGTH / 4 + 2 * scene.kernel_support, BOX_LENGTH)
            rows = cube_rows(scene, scene.tracers.particles_per_side) * min(BOX_LENGTH / ranks / width, 1.0)
            tables = min(settings.frames + 1, settings.combined_steps + 1) * speed.combined_tables.at(own)
        step = speed.combined_step.at(rows)
        parts["steps"] += settings.combined_steps * step + tables
        parts["validation"] += min(settings.combined_steps, VALIDATIONS + 1) * COMBINED_DRAWS * LOSS_ALONE * step
    return parts


def horizon_seconds(scene: Scene, work: ParticleWork, ranks: int, speeds: Speeds) -> dict[str, float]:
    """Seconds of the optimiser steps through horizons, and of their validations."""
    settings = scene.training.horizons
    if settings is None:
        return {}
    rest = evaluation_seconds(scene, work, ranks, speeds, 0)
    iteration = evaluation_seconds(scene, work, ranks, speeds, 1) - rest
    interval = scene.tracers.frame_interval
    evaluations = settings.scheme.evaluations * round(interval / (settings.time_step or interval))  # of a frame
    measured = settings.energy_weight > 0
    forth = evaluations * (rest + FORESEEN * iteration) + measured * COLD * iteration
    both = (evaluations * (WITH_GRADIENT * rest + (2 * FORESEEN + ADJOINT) * iteration)
            + measured * (COLD + ADJOINT) * iteration)
    return {"horizon start": CHECKPOINTING_SECONDS, "horizons": settings.steps * sum(settings.frames) * both,
            "horizon validation": len(settings.frames) * (HORIZON_VALIDATIONS + 2) * max(settings.frames) * forth}


def rollout_cost(scene: Scene, ranks: int, speeds: Speeds) -> StageCost:
    """Of a rollout: its steps, its frames, and the files."""
    course, settings = rollout_course(scene), scene.simulation
    own, disk, memory = scene.tracers.particles / ranks, rollout_bytes(scene, course), PROCESS_BYTES
    evaluation, first = 0.0, 0.0
    parts = {"start": START_SECONDS + (TORCH_SECONDS if set(scene.stages) <= {"dns", "simulate", "report"} else 0.0)}
    if "model" in settings.needs:
        work = particle_work(scene)
        evaluation, first = (evaluation_seconds(scene, work, ranks, speeds, iterations)
                             for iterations in (work.iterations, COLD))
        memory = particle_bytes(work, speeds.particles, ranks)
    parts["steps"] = first + (course.evaluations - 1) * evaluation
    if settings.on_grid:
        coarse = coarse_scene(scene)
        moved = speeds.coarse.tracers * busiest_cells(coarse, ranks)
        parts["steps"] = course.steps * (cost(coarse, ranks, speeds.coarse).seconds + moved)
        memory += flow_bytes(coarse, ranks)
    parts["frames"] = course.evaluations_of_frames * evaluation
    parts["files"] = disk / FILE_BYTES_PER_SECOND
    return StageCost("simulate", parts, memory + STORED_BYTES * own, disk)


def evaluation_seconds(scene: Scene, work: ParticleWork, ranks: int, speeds: Speeds, iterations: float) -> float:
    """Seconds of an evaluation of the model with so many iterations of its solve, if it has one."""
    work = replace(work, iterations=iterations if work.wavenumber else 0.0)
    return particle_cost(work, speeds.particles, ranks, threads(), speeds.flow.bandwidth).seconds


def frame_bytes(scene: Scene, work: ParticleWork, ranks: int, speeds: Speeds) -> float:
    """Memory of a rank for a frame that is trained on: a halo, lists and a grid of its own."""
    size = particle_bytes(work, speeds.particles, ranks) - PROCESS_BYTES
    if scene.training and scene.training.field_weight > 0:
        neighbors = NEIGHBOR_BYTES * scene.kernel.neighbors
        size += (FRAME_BYTES + neighbors) * scene.tracers.particles / ranks
    return size
