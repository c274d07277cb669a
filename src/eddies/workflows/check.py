"""What a scene amounts to: resolution, steps, ranks, memory, time. Told before a run; writes nothing."""

import logging
import math
from collections.abc import Iterator

from eddies.clock import duration
from eddies.scene import BOX_LENGTH, Scene
from eddies.workflows.estimates import (PROCESS_BYTES, expected_step, expected_turbulence, flow_bytes,
                                        largest_wavenumber, most_ranks, pair_bytes, particle_reach,
                                        probe_seconds_per_step, run_time)

log = logging.getLogger("eddies")


def run(scene: Scene, comm) -> None:
    """Log every derived number of a scene, estimates of steps and time, and warnings; all ranks call it."""
    subjects = {"grid": grid_lines(scene), "turbulence": turbulence_lines(scene),
                "particles": particle_lines(scene), "time step": step_lines(scene),
                "ranks": rank_lines(scene), "memory": memory_lines(scene), "time": time_lines(scene, comm)}
    log.info("%s: %s", scene.name, scene.title)
    log.info("stages: %s", ", ".join(scene.stages))
    for title, lines in subjects.items():
        for index, line in enumerate(lines):
            log.info("%-12s%s", "" if index else title, line)
    if comm.rank == 0:
        for problem in warnings(scene, comm.size):
            log.warning(problem)


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
    k_max_transfer, nyquist_transfer = (math.exp(-(k * tracers.width) ** 2 / 24) for k in (k_max, nyquist))
    yield (f"{tracers.particles_per_side}^3 = {tracers.particles}, mean spacing {tracers.spacing:.4g} = "
           f"{tracers.spacing * scene.flow.cells / BOX_LENGTH:.3g} cells")
    yield (f"filter width {tracers.width:.4g}, passes {k_max_transfer:.2g} of the amplitude at k_max and "
           f"{nyquist_transfer:.2g} at k = {nyquist:g}, where the particles' resolution ends")
    field_interval = tracers.field_every * tracers.frame_interval
    yield f"filtered fields on {tracers.cells}^3 points, every {field_interval:.3g}"
    if scene.kernel:
        yield (f"kernel support {scene.kernel.support(tracers.particles):.4g}, {scene.kernel.neighbors:g} "
               f"neighbours; reach with skin and drift {particle_reach(scene):.4g}")


def step_lines(scene: Scene) -> Iterator[str]:
    """Time steps and how many of them."""
    expected, span = expected_step(scene), run_time(scene)
    if expected is None:
        yield "not foreseen: the flow comes from a file"
        return
    step, limit = expected
    steps = f", about {math.ceil(span / step)} steps for a time of {span:.3g}" if span else ""
    yield f"{step:.4g}, {limit}{steps}"
    if scene.tracers:
        interval = scene.tracers.frame_interval
        yield f"with tracers at most that, and a whole fraction of the frame interval {interval:g}"


def rank_lines(scene: Scene) -> Iterator[str]:
    """How many ranks can be used, and why no more."""
    limits = most_ranks(scene)
    yield f"at most {min(limits.values())}"
    for reason, ranks in limits.items():
        yield f"    {ranks}: {reason}"


def memory_lines(scene: Scene) -> Iterator[str]:
    """Memory of a job: number of ranks times that of each."""
    most = min(most_ranks(scene).values())
    for ranks in (2**m for m in range(most.bit_length())):
        line = f"{ranks} x {megabytes(PROCESS_BYTES + flow_bytes(scene) / ranks)} for the direct simulation"
        if scene.simulation:
            line += f", {ranks} x {megabytes(PROCESS_BYTES + pair_bytes(scene) / ranks)} for the pair force"
        yield line


def time_lines(scene: Scene, comm) -> Iterator[str]:
    """Wall time of the direct simulation on the ranks at hand; every rank must draw the lines."""
    seconds = probe_seconds_per_step(scene, comm)
    ranks = "this rank" if comm.size == 1 else f"these {comm.size} ranks"
    yield f"{seconds:.3g} s for a step of the direct simulation on {ranks}"
    expected, span = expected_step(scene), run_time(scene)
    if expected and span:
        total = duration(seconds * math.ceil(span / expected[0]))
        yield f"direct simulation about {total}, tracers and files not counted"


def warnings(scene: Scene, ranks: int) -> Iterator[str]:
    """What is likely to go wrong."""
    turbulence, most = expected_turbulence(scene), min(most_ranks(scene).values())
    if turbulence and largest_wavenumber(scene) * turbulence.kolmogorov_length < 0.9:
        needed = math.ceil(3 / turbulence.kolmogorov_length) + 1
        yield (f"k_max eta is below 0.9, the dissipation is not resolved: raise [flow] cells to {needed} or "
               "the viscosity")
    if scene.tracers and scene.tracers.width < BOX_LENGTH / scene.flow.cells:
        yield "the filter is narrower than a cell of the grid: it filters nothing"
    if ranks > most:
        yield f"this job has {ranks} ranks, and the scene can use at most {most}"


def megabytes(size: float) -> str:
    """Bytes for people."""
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
