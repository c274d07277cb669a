"""What a scene amounts to: resolution, steps, ranks, memory, time. Told before a run; writes nothing."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from eddies.clock import duration
from eddies.io.single_writer import LARGEST_BYTES, has_single_writer
from eddies.kernels.library import threads
from eddies.parallel.communicator import Comm
from eddies.scene.scene import BOX_LENGTH, Scene
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.workflows.foreseen.cost_model import Speed, cost, costs
from eddies.workflows.foreseen.estimates import (expected_step, expected_turbulence, flow_steps, ground_truth_alone,
                                                 largest_wavenumber, most_ranks, particle_reach, run_time, sees_pairs)
from eddies.workflows.foreseen.network import LATENCY, NODE_BANDWIDTH, NODE_CORES
from eddies.workflows.foreseen.numbers import mach, numbers
from eddies.workflows.foreseen.particle_work import particle_work
from eddies.workflows.foreseen.refusals import refusals
from eddies.workflows.foreseen.rollout_course import rollout_course
from eddies.workflows.foreseen.stage_cost import Speeds, StageCost, in_units
from eddies.workflows.foreseen.stage_costs import probe_scene, stage_costs, totals
from eddies.workflows.foreseen.warnings import warnings

if TYPE_CHECKING:
    from eddies.workflows.foreseen.particle_cost import ParticleCost

log = logging.getLogger("eddies")


def run(scene: Scene, comm: Comm, as_json: bool = False) -> None:
    """Log every derived number of a scene, what its stages need here, and warnings; or print them for programs. All
    ranks call it."""
    speeds = probe_scene(scene, comm)
    stages, rollout = stage_costs(scene, comm.size, speeds), rollout_costs(scene, speeds)
    refused, doubts = refusals(scene, comm, stages), list(warnings(scene, comm.size))
    if as_json:
        if comm.rank == 0:
            found = numbers(scene, comm.size, speeds, stages, rollout, doubts, refused)
            print(json.dumps(found, indent=2, allow_nan=False))
        return
    subjects = {"grid": grid_lines(scene), "turbulence": turbulence_lines(scene),
                "particles": particle_lines(scene), "time step": step_lines(scene), "rollout": course_lines(scene),
                "ranks": rank_lines(scene, comm), "stages": stage_lines(scene, comm.size, speeds, stages),
                "fails here": refused, "more ranks": cost_lines(scene, speeds.flow), "": rollout_lines(scene, rollout)}
    log.info("%s: %s", scene.name, scene.title)
    if scene.variant:
        log.info("%-12s%s; these numbers are those of the scene, --variant NAME gives others", "variants",
                 ", ".join(scene.variant))
    for title, lines in subjects.items():
        for index, line in enumerate(lines):
            log.info("%-12s%s", "" if index else title, line)
    if comm.rank == 0:
        for problem in doubts:
            log.warning(problem)


def rollout_costs(scene: Scene, speeds: Speeds) -> list[ParticleCost]:
    """Costs of the particles' evaluations on any number of ranks where the scene simulates with a model that was
    probed, else none."""
    if speeds.particles is None or scene.simulation is None or "model" not in scene.simulation.needs:
        return []
    from eddies.workflows.foreseen.particle_cost import particle_costs  # torch, where there is a model
    return particle_costs(particle_work(scene), speeds.particles, min(most_ranks(scene).values()),
                          speeds.flow.bandwidth)


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
    if (reached := mach(scene)) is not None:
        yield f"turbulent Mach number {reached:.3g}"


def particle_lines(scene: Scene) -> Iterator[str]:
    """Particle spacing, filter and kernel."""
    tracers = scene.tracers
    if tracers is None:
        yield "none"
        return
    k_max, nyquist = largest_wavenumber(scene), tracers.particles_per_side / 2
    k_max_transfer, nyquist_transfer = (gaussian_transfer(k**2, tracers.filter_width) for k in (k_max, nyquist))
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
    steps = f", about {sum(flow_steps(scene))} steps for a time of {span:.3g}" if span else ""
    yield f"{step:.4g}, {limit}{steps}"
    if scene.tracers:
        interval = scene.tracers.frame_interval
        yield f"with tracers at most that, and a whole fraction of the frame interval {interval:g}"


def rank_lines(scene: Scene, comm: Comm) -> Iterator[str]:
    """How many ranks can be used, and why no more; and who writes, if not all."""
    limits, alone = most_ranks(scene), most_ranks(ground_truth_alone(scene))
    yield f"at most {min(limits.values())}"
    for reason, ranks in limits.items():
        yield f"    {ranks}: {reason}"
    if min(alone.values()) > min(limits.values()):
        yield f"the direct simulation alone (`eddies dns`) at most {min(alone.values())}: {min(alone, key=alone.get)}"
    if has_single_writer(comm):
        yield f"rank 0 writes for all, up to {in_units(LARGEST_BYTES)} a file: this h5py is built without MPI"


def course_lines(scene: Scene) -> Iterator[str]:
    """Steps, frames and evaluations of the rollout."""
    course = rollout_course(scene)
    if course is None:
        return
    yield (f"step {course.time_step:.3g}, {course.steps_per_frame:.3g} steps a frame, about {course.steps} for "
           f"{course.intervals} intervals of {course.interval:g}")
    if course.evaluations:
        yield (f"about {course.evaluations} evaluations for the steps, {course.evaluations_per_turnover:.3g} a "
               f"turnover, and {course.evaluations_of_frames} for frames between them")


def stage_lines(scene: Scene, ranks: int, speeds: Speeds, stages: Sequence[StageCost]) -> Iterator[str]:
    """What each stage needs on the ranks at hand."""
    step = f"a step of the direct simulation {number(cost(scene, ranks, speeds.flow).seconds)} s"
    yield f"about, on {'this rank' if ranks == 1 else f'these {ranks} ranks'}, as probed now; {step}"
    yield "stage         wall time  memory a rank      disk  most of it"
    foreseen = {cost.stage: cost for cost in stages}
    for stage in scene.stages:
        if (found := foreseen.get(stage)) is None:
            yield f"{stage:12}  not foreseen: {speeds.missing[stage]}"
            continue
        longest = max(found.parts, key=found.parts.__getitem__)
        yield (f"{stage:12}  {duration(found.seconds):>9}  {in_units(found.memory):>13}  {in_units(found.disk):>8}  "
               f"{longest} {found.parts[longest] / found.seconds:.0%}")
    total = totals(stages)
    yield (f"{'in all':12}  {duration(total['seconds']):>9}  {in_units(total['memory']):>13}  "
           f"{in_units(total['disk']):>8}  at most {in_units(total['most_disk'])} of disk meanwhile")


def cost_lines(scene: Scene, speed: Speed) -> Iterator[str]:
    """Memory and wall time of the direct simulation on any number of ranks."""
    yield (f"estimates, from the work of the ranks at hand, for nodes of {NODE_CORES} cores that share "
           f"{NODE_BANDWIDTH / 1e9:g} GB/s, {1e6 * LATENCY:g} us a message")
    if threads() > 1:
        yield f"the direct simulation, {threads()} threads a rank:"
    yield "ranks  nodes  planes  memory a rank  s a step     wall time  core hours"
    steps = sum(flow_steps(scene) or (0, 0))
    for row in costs(scene, min(most_ranks(ground_truth_alone(scene)).values()), speed):
        line = f"{row.ranks:5}  {row.nodes:5}  {row.planes:6}  {in_units(row.memory):>13}  {number(row.seconds):>8}"
        if steps:
            seconds = row.seconds * steps
            line += f"  {duration(seconds):>12}  {row.ranks * threads() * seconds / 3600:10,.1f}"
        yield line


def rollout_lines(scene: Scene, rows: Sequence[ParticleCost]) -> Iterator[str]:
    """Memory and wall time of the particles with the learned model on any number of cores."""
    if not rows:
        return
    work, course = particle_work(scene), rollout_course(scene)
    evaluations = course.evaluations + course.evaluations_of_frames if course else None
    per_step = scene.simulation.scheme.evaluations
    steps = f"{per_step} evaluations a step" + (f", {work.iterations:g} iterations each" if work.iterations else "")
    yield f"the same for the learned model, {steps}; threads are OMP_NUM_THREADS of a rank"
    yield "cores  ranks x threads  memory a rank  s an evaluation  s a step     wall time  most of it"
    for row in rows:
        wall = duration(row.seconds * evaluations) if evaluations else "-"
        yield (f"{row.cores:5}  {row.ranks:5} x {row.threads:<7}  {in_units(row.memory):>13}  "
               f"{number(row.seconds):>15}  {number(per_step * row.seconds):>8}  {wall:>12}  {row.binds} "
               f"{row.parts[row.binds] / row.seconds:.0%}")


def number(value: float) -> str:
    """Three digits, or all of an integer part that has more."""
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"
