"""What a scene amounts to: resolution, steps, ranks, memory, time. Told before a run; writes nothing."""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

from eddies.clock import duration
from eddies.kernels.library import threads
from eddies.parallel.communicator import Comm
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.workflows.foreseen.cost_model import Speed, cost, costs, probe
from eddies.workflows.foreseen.estimates import (expected_step, expected_turbulence, foreseen_allowed_step,
                                                 ground_truth_alone, largest_wavenumber, most_ranks, particle_reach,
                                                 run_time, sees_pairs)
from eddies.workflows.foreseen.network import LATENCY, NODE_BANDWIDTH, NODE_CORES
from eddies.workflows.foreseen.particle_work import EVALUATIONS, particle_work, rollout_evaluations

if TYPE_CHECKING:
    from eddies.workflows.foreseen.particle_cost import ParticleCost

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, as_json: bool = False) -> None:
    """Log every derived number of a scene, estimates of steps and time, and warnings; or print them for programs. All
    ranks call it."""
    speed = probe(scene, comm)
    rollout = rollout_costs(scene, comm, speed)
    if as_json:
        if comm.rank == 0:
            print(json.dumps(numbers(scene, comm.size, speed, rollout), indent=2, allow_nan=False))
        return
    subjects = {"grid": grid_lines(scene), "turbulence": turbulence_lines(scene),
                "particles": particle_lines(scene), "time step": step_lines(scene),
                "ranks": rank_lines(scene), "time": time_lines(scene, comm.size, speed),
                "more ranks": cost_lines(scene, speed), "rollout": rollout_lines(scene, rollout)}
    log.info("%s: %s", scene.name, scene.title)
    log.info("stages: %s", ", ".join(scene.stages))
    for title, lines in subjects.items():
        for index, line in enumerate(lines):
            log.info("%-12s%s", "" if index else title, line)
    if comm.rank == 0:
        for problem in warnings(scene, comm.size):
            log.warning(problem)


def rollout_costs(scene: Scene, comm: Comm, speed: Speed) -> list[ParticleCost]:
    """Costs of the particles' evaluations where the scene simulates with a model, and not on a GPU, else none; all
    ranks call it."""
    settings = scene.simulation
    if settings is None or scene.model is None or "model" not in settings.needs or scene.device != "cpu":
        return []
    from eddies.workflows.foreseen import particle_cost, particle_probe  # torch, where there is a model
    try:
        found = particle_probe.probe_particles(scene, comm)
    except particle_probe.ProbeError as error:  # on all ranks
        if comm.rank == 0:
            log.warning("time and memory of the particles are not foreseen: %s", error)
        return []
    return particle_cost.particle_costs(particle_work(scene), found, min(most_ranks(scene).values()), speed.bandwidth)


def numbers(scene: Scene, ranks: int, speed: Speed, rollout: Sequence[ParticleCost]) -> dict[str, Any]:
    """The same for programs: lengths and times in the scene's units, memory in bytes; None where nothing is foreseen.

    `limits` are the largest numbers of ranks by what limits them, `costs` those of the direct simulation,
    `rollout_costs` those of the particles with the learned model.
    """
    turbulence, step, limits = expected_turbulence(scene), expected_step(scene), most_ranks(scene)
    alone = min(most_ranks(ground_truth_alone(scene)).values())
    return {
        "scene": scene.name, "stages": list(scene.stages), "cells": scene.flow.cells,
        "largest_wavenumber": largest_wavenumber(scene),
        "turbulence": turbulence and {name: getattr(turbulence, name) for name in (
            "velocity_rms", "dissipation_rate", "reynolds_lambda", "turnover_time", "kolmogorov_length",
            "kolmogorov_time")},
        "particles": scene.tracers and scene.tracers.particles,
        "filter_width": scene.tracers and scene.tracers.filter_width,
        "kernel_support": scene.kernel_support,
        "time_step": step and step[0], "steps": expected_steps(scene), "ranks": ranks,
        "most_ranks": min(limits.values()), "limits": limits, "most_ranks_dns": alone,
        "costs": [{"ranks": row.ranks, "nodes": row.nodes, "memory": row.memory, "seconds_per_step": row.seconds}
                  for row in costs(scene, alone, speed)],
        "rollout_costs": [rollout_numbers(scene, row) for row in rollout],
        "warnings": list(warnings(scene, ranks)),
    }


def rollout_numbers(scene: Scene, row: ParticleCost) -> dict[str, Any]:
    """A row of the rollout's costs; `seconds` are those of the whole rollout, `parts` those of an evaluation."""
    evaluations = rollout_evaluations(scene)
    return {"ranks": row.ranks, "threads": row.threads, "cores": row.cores, "nodes": row.nodes, "memory": row.memory,
            "seconds_per_evaluation": row.seconds,
            "seconds_per_step": EVALUATIONS[scene.simulation.integrator] * row.seconds,
            "seconds": evaluations and evaluations * row.seconds, "parts": row.parts, "binds": row.binds}


def grid_lines(scene: Scene) -> Iterator[str]:
    """Grid spacing and resolved wavenumbers."""
    cells = scene.flow.cells
    yield f"{cells}^3 cells, spacing {BOX_LENGTH / cells:.4g}, k_max {largest_wavenumber(scene)} (2/3 rule)"


def turbulence_lines(scene: Scene) -> Iterator[str]:
    """Expected scales of the turbulence."""
    turbulence = expected_turbulence(scene)
    if turbulence is None:
        yield "not foreseen: no forcing, no random start, or no viscosity"
        return
    eta, u_rms = turbulence.kolmogorov_length, turbulence.velocity_rms
    yield (f"expected u' {u_rms:.3g}, dissipation rate {turbulence.dissipation_rate:.3g}, Re_lambda "
           f"{turbulence.reynolds_lambda:.3g}, turnover time {turbulence.turnover_time:.3g}")
    yield (f"Kolmogorov length {eta:.3g}, time {turbulence.kolmogorov_time:.3g}, k_max eta "
           f"{largest_wavenumber(scene) * eta:.3g}")
    if scene.flow.sound_speed:
        yield f"turbulent Mach number {math.sqrt(3) * u_rms / scene.flow.sound_speed:.3g}"


def particle_lines(scene: Scene) -> Iterator[str]:
    """Particle spacing, filter and kernel."""
    tracers = scene.tracers
    if tracers is None:
        yield "none"
        return
    k_max, nyquist = largest_wavenumber(scene), tracers.particles_per_side / 2
    k_max_transfer, nyquist_transfer = (math.exp(-(k * tracers.filter_width) ** 2 / 24) for k in (k_max, nyquist))
    yield (f"{tracers.particles_per_side}^3 = {tracers.particles}, mean spacing {tracers.spacing:.4g} = "
           f"{tracers.spacing * scene.flow.cells / BOX_LENGTH:.3g} cells")
    yield (f"filter width {tracers.filter_width:.4g}, passes {k_max_transfer:.2g} of the amplitude at k_max and "
           f"{nyquist_transfer:.2g} at k = {nyquist:g}, where the particles' resolution ends")
    field_interval = tracers.field_every * tracers.frame_interval
    yield f"filtered fields on {tracers.cells}^3 points, every {field_interval:.3g}"
    if scene.kernel:
        yield f"kernel support {scene.kernel_support:.4g}, {scene.kernel.neighbors:g} neighbours"
    if sees_pairs(scene):
        yield (f"radius of interaction {scene.interaction_radius:.4g}, {scene.neighbors:g} neighbours; reach with skin "
               f"{particle_reach(scene):.4g}")


def step_lines(scene: Scene) -> Iterator[str]:
    """Time steps and how many of them."""
    expected, span = expected_step(scene), run_time(scene)
    if expected is None:
        yield "not foreseen: the speed of the initial flow is not known"
        return
    step, limit = expected
    steps = f", about {expected_steps(scene)} steps for a time of {span:.3g}" if span else ""
    yield f"{step:.4g}, {limit}{steps}"
    if scene.tracers:
        interval = scene.tracers.frame_interval
        yield f"with tracers at most that, and a whole fraction of the frame interval {interval:g}"


def rank_lines(scene: Scene) -> Iterator[str]:
    """How many ranks can be used, and why no more."""
    limits, alone = most_ranks(scene), most_ranks(ground_truth_alone(scene))
    yield f"at most {min(limits.values())}"
    for reason, ranks in limits.items():
        yield f"    {ranks}: {reason}"
    if min(alone.values()) > min(limits.values()):
        yield f"the direct simulation alone (`eddies dns`) at most {min(alone.values())}: {min(alone, key=alone.get)}"


def time_lines(scene: Scene, ranks: int, speed: Speed) -> Iterator[str]:
    """Wall time of the direct simulation on the ranks at hand."""
    seconds, steps = cost(scene, ranks, speed).seconds, expected_steps(scene)
    at_hand = "this rank" if ranks == 1 else f"these {ranks} ranks"
    yield f"{number(seconds)} s for a step of the direct simulation on {at_hand}"
    if steps:
        yield f"direct simulation about {duration(seconds * steps)}, statistics, tracers and files not counted"


def cost_lines(scene: Scene, speed: Speed) -> Iterator[str]:
    """Memory and wall time of the direct simulation on any number of ranks."""
    yield (f"estimates, from the work of the ranks at hand, for nodes of {NODE_CORES} cores that share "
           f"{NODE_BANDWIDTH / 1e9:g} GB/s, {1e6 * LATENCY:g} us a message")
    if threads() > 1:
        yield f"the direct simulation, {threads()} threads a rank:"
    yield "ranks  nodes  planes  memory a rank  s a step     wall time  core hours"
    steps = expected_steps(scene)
    for row in costs(scene, min(most_ranks(ground_truth_alone(scene)).values()), speed):
        line = f"{row.ranks:5}  {row.nodes:5}  {row.planes:6}  {megabytes(row.memory):>13}  {number(row.seconds):>8}"
        if steps:
            seconds = row.seconds * steps
            line += f"  {duration(seconds):>12}  {row.ranks * threads() * seconds / 3600:10,.1f}"
        yield line


def rollout_lines(scene: Scene, rows: Sequence[ParticleCost]) -> Iterator[str]:
    """Memory and wall time of the particles with the learned model on any number of cores."""
    if not rows:
        return
    work, evaluations = particle_work(scene), rollout_evaluations(scene)
    per_step = EVALUATIONS[scene.simulation.integrator]
    steps = f"{per_step} evaluations a step" + (f", {work.iterations:g} iterations each" if work.iterations else "")
    yield f"the same for the learned model, {steps}; threads are OMP_NUM_THREADS of a rank"
    yield "cores  ranks x threads  memory a rank  s an evaluation  s a step     wall time  most of it"
    for row in rows:
        wall = duration(row.seconds * evaluations) if evaluations else "-"
        yield (f"{row.cores:5}  {row.ranks:5} x {row.threads:<7}  {megabytes(row.memory):>13}  "
               f"{number(row.seconds):>15}  {number(per_step * row.seconds):>8}  {wall:>12}  {row.binds} "
               f"{row.parts[row.binds] / row.seconds:.0%}")


def expected_steps(scene: Scene) -> int | None:
    """Steps of the direct simulation; None if they cannot be foreseen."""
    expected, span = expected_step(scene), run_time(scene)
    return math.ceil(span / expected[0]) if expected and span else None


def warnings(scene: Scene, ranks: int) -> Iterator[str]:
    """What is likely to go wrong."""
    turbulence, most = expected_turbulence(scene), min(most_ranks(scene).values())
    if turbulence and largest_wavenumber(scene) * turbulence.kolmogorov_length < 0.9:
        needed = math.ceil(3 / turbulence.kolmogorov_length) + 1
        yield (f"k_max eta is below 0.9, the dissipation is not resolved: raise [flow] cells to {needed} or "
               "the viscosity")
    if scene.model and scene.model.path and not scene.model.weights_file.is_file():
        yield (f'[model] path = "{scene.model.path}": there is no {scene.model.weights_file} yet, which `eddies train` '
               "will want")
    if scene.training and scene.model.path is None and scene.training.horizons is None:
        for name, settings in scene.model.settings.items():
            if settings.learns_through_horizons:
                yield (f'[model] terms: "{name}" is trained through horizons alone, and stays as it starts without '
                       "them: add [training.horizons]")
    if scene.simulation and "model" in scene.simulation.needs and "resolved" in scene.model.reads:
        allowed = foreseen_allowed_step(scene)
        if allowed and scene.simulation.injection != "none" and scene.simulation.step > allowed * (1 + 1e-9):
            yield (f"[simulation] step = {scene.simulation.step:g}: the particles will take shorter steps, of about "
                   f"{allowed:.2g}, in which their resolved velocity can follow the flow")
    if scene.tracers and scene.tracers.filter_width < BOX_LENGTH / scene.flow.cells:
        yield "the filter is narrower than a cell of the grid: it filters nothing"
    if ranks > most:
        yield f"this job has {ranks} ranks, and the scene can use at most {most}"


def number(value: float) -> str:
    """Three digits, or all of an integer part that has more."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def megabytes(size: float) -> str:
    """Bytes for people."""
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
