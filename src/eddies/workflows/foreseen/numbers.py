"""What is foreseen of a scene, for programs: docs/check.md describes every key."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from eddies.scene.scene import Scene
from eddies.workflows.foreseen.cost_model import costs
from eddies.workflows.foreseen.estimates import (expected_step, expected_turbulence, flow_steps, ground_truth_alone,
                                                 largest_wavenumber, most_ranks, rms_speed)
from eddies.workflows.foreseen.rollout_course import RolloutCourse, rollout_course
from eddies.workflows.foreseen.stage_cost import Speeds, StageCost
from eddies.workflows.foreseen.stage_costs import totals

if TYPE_CHECKING:
    from eddies.workflows.foreseen.particle_cost import ParticleCost

OF_TURBULENCE = ("velocity_rms", "dissipation_rate", "reynolds_lambda", "turnover_time", "kolmogorov_length",
                 "kolmogorov_time")
OF_COURSE = ("time_step", "intervals", "steps", "steps_per_frame", "evaluations", "evaluations_of_frames",
             "evaluations_per_turnover")


def numbers(scene: Scene, ranks: int, speeds: Speeds, stages: Sequence[StageCost], rollout: Sequence[ParticleCost],
            warnings: Sequence[str], refusals: Sequence[str]) -> dict[str, Any]:
    """Lengths and times of the flow in the scene's units, wall times in seconds, sizes in bytes; None where nothing is
    foreseen."""
    step, limits, steps = expected_step(scene), most_ranks(scene), flow_steps(scene)
    alone, course = min(most_ranks(ground_truth_alone(scene)).values()), rollout_course(scene)
    return {
        "scene": scene.name, "stages": list(scene.stages), "cells": scene.flow.cells,
        "largest_wavenumber": largest_wavenumber(scene),
        "turbulence": turbulence_numbers(scene),
        "mach_turbulent": mach(scene),
        "particles": scene.tracers and scene.tracers.particles,
        "filter_width": scene.tracers and scene.tracers.filter_width,
        "kernel_support": scene.kernel_support,
        "time_step": step and step[0], "steps": steps and sum(steps), "ranks": ranks,
        "most_ranks": min(limits.values()), "limits": limits, "most_ranks_dns": alone,
        "rollout": course and {name: getattr(course, name) for name in OF_COURSE},
        "stage_costs": [{"stage": cost.stage, "seconds": cost.seconds, "memory": cost.memory, "disk": cost.disk,
                         "scratch": cost.scratch, "parts": cost.parts} for cost in stages],
        "totals": totals(stages), "not_foreseen": speeds.missing,
        "costs": [{"ranks": row.ranks, "nodes": row.nodes, "memory": row.memory, "seconds_per_step": row.seconds}
                  for row in costs(scene, alone, speeds.flow)],
        "rollout_costs": [rollout_numbers(scene, course, row) for row in rollout],
        "warnings": list(warnings), "refusals": list(refusals),
    }


def turbulence_numbers(scene: Scene) -> dict[str, float] | None:
    """The scales of the turbulence that is expected."""
    turbulence = expected_turbulence(scene)
    return turbulence and {**{name: getattr(turbulence, name) for name in OF_TURBULENCE},
                           "kmax_eta": largest_wavenumber(scene) * turbulence.kolmogorov_length}


def mach(scene: Scene) -> float | None:
    """The turbulent Mach number that is expected; None without sound."""
    speed = rms_speed(scene)
    return speed / scene.flow.sound_speed if speed is not None and scene.flow.sound_speed else None


def rollout_numbers(scene: Scene, course: RolloutCourse | None, row: ParticleCost) -> dict[str, Any]:
    """A row of the rollout's costs; `seconds` are those of its evaluations, `parts` those of one."""
    return {"ranks": row.ranks, "threads": row.threads, "cores": row.cores, "nodes": row.nodes, "memory": row.memory,
            "seconds_per_evaluation": row.seconds,
            "seconds_per_step": scene.simulation.scheme.evaluations * row.seconds,
            "seconds": course and (course.evaluations + course.evaluations_of_frames) * row.seconds,
            "parts": row.parts, "binds": row.binds}
