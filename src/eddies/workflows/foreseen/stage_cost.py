"""What a stage of a scene needs, and of the direct simulation and the report how much: time, memory, disk.

What is repeated is timed by the probes and counted from the scene; what is not, and does not grow, are constants here
and in `learning_cost`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

from eddies.scene.scene import Scene
from eddies.workflows.foreseen.cost_model import Speed, busiest_cells, cost, flow_bytes
from eddies.workflows.foreseen.estimates import flow_steps, tracer_intervals
from eddies.workflows.foreseen.rollout_course import rollout_course
from eddies.workflows.foreseen.stored import (FIGURE_BYTES, SAMPLE_EVERY, flow_scratch_bytes, ground_truth_bytes,
                                              true_frames)

if TYPE_CHECKING:
    from eddies.workflows.foreseen.particle_probe import ParticleSpeed
    from eddies.workflows.foreseen.training_probe import TrainingSpeed

# Seconds in which a stage loads modules, plans and opens files; torch not counted. Of tiny on one idle rank.
START_SECONDS = 0.5
FILE_BYTES_PER_SECOND = 250e6  # to and from a local disk, as the frames of hit-small take
FRAME_SECONDS = 0.003        # to open what a frame is written into or read from, as the frames of tiny take
# Of a report on one rank: modules, a figure, what is computed of a particle of a frame; memory of a rank. From reports
# of tiny and hit-small.
REPORT_START_SECONDS, FIGURE_SECONDS, FRAME_PARTICLE_SECONDS, REPORT_BYTES = 1.0, 0.45, 7e-7, 280e6
FIGURES = {"dns": 4, "train-kernel": 3, "train": 2, "simulate": 8}


@dataclass(frozen=True)
class StageCost:
    """What a stage needs: `parts` are seconds; `memory` of the rank that has most; `disk` what it leaves in the run
    directory, `scratch` what it needs there beside until it ends; all in bytes."""

    stage: str
    parts: dict[str, float]
    memory: float
    disk: float
    scratch: float = 0.0

    @property
    def seconds(self) -> float:
        """Wall time."""
        return sum(self.parts.values())


@dataclass(frozen=True)
class Speeds:
    """What the probes found: of the flow, and where a scene has them of particles with the model, of training, and of a
    coarse grid. `missing` says by stage why it is not foreseen."""

    flow: Speed
    particles: ParticleSpeed | None
    training: TrainingSpeed | None
    missing: dict[str, str]
    coarse: Speed | None = None


def flow_cost(scene: Scene, ranks: int, speeds: Speeds) -> StageCost:
    """Of the direct simulation: its frames are written twice and read once."""
    alone, with_tracers = flow_steps(scene)
    steps, cells, disk = alone + with_tracers, busiest_cells(scene, ranks), ground_truth_bytes(scene)
    frames = tracer_intervals(scene) + 1 if scene.tracers else 0
    parts = {"start": START_SECONDS, "steps": steps * cost(scene, ranks, speeds.flow).seconds,
             "statistics": steps / SAMPLE_EVERY * speeds.flow.sample * cells,
             "tracers": (with_tracers + frames) * speeds.flow.tracers * cells,
             "files": (3 if scene.tracers else 1) * disk / FILE_BYTES_PER_SECOND + frames * FRAME_SECONDS}
    return StageCost("dns", parts, flow_bytes(scene, ranks), disk, flow_scratch_bytes(scene))


def report_cost(scene: Scene, ranks: int, speeds: Speeds) -> StageCost:
    """Of the report, whose figures the ranks share."""
    figures = sum(FIGURES.get(stage, 0) for stage in scene.stages)
    frames, course = (tracer_intervals(scene) or 0) if scene.tracers else 0, rollout_course(scene)
    if course:
        frames += course.intervals + 1 + true_frames(scene, course)
    particles = scene.tracers.particles if scene.tracers else 0
    parts = {"start": REPORT_START_SECONDS, "figures": FIGURE_SECONDS * figures / min(ranks, figures),
             "statistics": FRAME_PARTICLE_SECONDS * frames * particles}
    return StageCost("report", parts, REPORT_BYTES, FIGURE_BYTES * figures)


def in_units(size: float) -> str:
    """Bytes for people."""
    unit, name = next(((unit, name) for unit, name in ((1e9, "GB"), (1e6, "MB")) if size >= unit), (1e3, "kB"))
    return f"{size / unit:.3g} {name}" if name == "GB" else f"{size / unit:.0f} {name}"
