"""Memory and wall time of a scene on any number of ranks, from the step of a small grid on the ranks at hand.

A step of the direct simulation on P ranks takes

    T = work(n) p n^2 + 4 (bytes / bandwidth + 2 (P - 1) latency)

with n the cells along a side, p the planes of the busiest rank, rounded up to pairs because planes are transformed in
pairs, and work(n) seconds a cell. The nonlinear term is evaluated 4 times, and each time all modes go from columns to
planes and products back, as messages from each rank to every other. What stays on a node moves at the bandwidth of its
memory, what leaves it shares the node's network.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import median

import numpy as np

from eddies.clock import Clock
from eddies.flow.history import FlowHistory
from eddies.flow.subgrid import Closure
from eddies.flow.tracers import FilteredField, TracerParticles, release
from eddies.kernels.library import threads
from eddies.parallel.communicator import Comm
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.scene.scene import BOX_LENGTH, Initial, Scene
from eddies.spectral.fourier_passes import BLOCK_BYTES
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import STEPPERS
from eddies.workflows.foreseen.estimates import expected_turbulence, largest_wavenumber
from eddies.workflows.foreseen.network import LATENCY, RANK_BANDWIDTH, Network
from eddies.workflows.ground_truth.scene_flow import build_fluid, build_step_limit, initial_state

PROBE_CELLS = 64
EVALUATIONS = 4              # of the nonlinear term in a step, of either stepper
# Of a compressible fluid (True) and of an incompressible one (False): what is sent to planes, and back to columns.
SENT_COMPONENTS = {True: (8, 4), False: (5, 3)}
# Work of a cell over that at 64^3. It outgrows the transforms' log n because planes and their blocks outgrow the
# caches. From tests/benchmarks/step.py, from 256^3 on for the slab of one of many ranks (--share-of).
WORK_GROWTH = {64: 1.0, 128: 1.0, 256: 1.35, 512: 1.7, 1024: 2.75, 2048: 4.8}
# Memory of a rank, from runs at 64^3 to 128^3 on 1 and 2 ranks, and from thin slabs of 1024^3: of a cell in float64; of
# the block of planes that is worked on, in real arrays of a pair of planes; and what there is before any field.
FLOW_BYTES = {True: 320, False: 220}
BLOCK_ARRAYS = {True: 64, False: 32}
PROCESS_BYTES = 100e6
TRACER_BYTES = 300           # of a tracer, copies while it moves and is stored included


@dataclass(frozen=True)
class Speed:
    """The speed of the ranks at hand: `work`, seconds of a step for a cell of 64^3, and `bandwidth`, bytes a second to
    others; for such a cell the seconds of a sample of the statistics and of moving its tracers by a step as well."""

    work: float
    bandwidth: float
    sample: float = 0.0
    tracers: float = 0.0


@dataclass(frozen=True)
class Cost:
    """What a step of the direct simulation needs on so many ranks, of as many threads as those at hand; times in
    seconds, memory of a rank in bytes."""

    ranks: int
    planes: int
    memory: float
    work: float
    exchange: float

    @property
    def nodes(self) -> int:
        """Nodes that so many ranks fill."""
        return Network(self.ranks, RANK_BANDWIDTH, threads()).nodes

    @property
    def seconds(self) -> float:
        """Wall time of a step."""
        return self.work + self.exchange


def cost(scene: Scene, ranks: int, speed: Speed) -> Cost:
    """The cost of a step of a scene's direct simulation on `ranks` ranks, at most as many as it has planes."""
    return Cost(ranks, math.ceil(scene.flow.cells / ranks), flow_bytes(scene, ranks),
                speed.work * busiest_cells(scene, ranks), exchange_seconds(scene, ranks, speed))


def costs(scene: Scene, most: int, speed: Speed) -> list[Cost]:
    """Costs on 1, 2, 4, ... ranks up to `most`; the last twelve of these."""
    return [cost(scene, 2**m, speed) for m in range(most.bit_length())][-12:]


def busiest_cells(scene: Scene, ranks: int) -> float:
    """Cells of the busiest rank, as many as they would be of 64^3 by their work."""
    cells = scene.flow.cells
    return work_growth(cells) * cells**2 * busiest_planes(cells, ranks)


def busiest_planes(cells: int, ranks: int) -> int:
    """Planes that the busiest rank works for: an odd one costs as much as a pair."""
    return min(2 * math.ceil(math.ceil(cells / ranks) / 2), cells)


def work_growth(cells: int) -> float:
    """Work of a cell over that at 64^3."""
    return float(np.interp(math.log(cells), np.log(list(WORK_GROWTH)), list(WORK_GROWTH.values())))


def sent_bytes(scene: Scene) -> float:
    """Bytes of all modes that change between columns and planes for one nonlinear term, over all ranks."""
    K = largest_wavenumber(scene)
    components = sum(SENT_COMPONENTS[scene.flow.compressible])
    return components * scene.flow.cells * (2 * K + 1) * (K + 1) * 2 * real_bytes(scene)


def exchange_seconds(scene: Scene, ranks: int, speed: Speed) -> float:
    """Seconds of the messages of a step."""
    return EVALUATIONS * Network(ranks, speed.bandwidth, threads()).all_to_all(sent_bytes(scene), times=2)


def real_bytes(scene: Scene) -> int:
    """Bytes of a real number of the grid arrays."""
    return 4 if scene.flow.precision == "float32" else 8


def flow_bytes(scene: Scene, ranks: int) -> float:
    """Memory of a rank in the direct simulation."""
    fluid, cells, real = scene.flow.compressible, scene.flow.cells, real_bytes(scene)
    block = BLOCK_ARRAYS[fluid] * max(threads() * BLOCK_BYTES, 2 * cells**2 * real)
    planes = math.ceil(cells / ranks)
    size = PROCESS_BYTES + FLOW_BYTES[fluid] * real / 8 * cells**2 * planes + block
    if scene.tracers:
        size += 3 * real * cells**2 * planes + TRACER_BYTES * scene.tracers.particles / ranks
    return size


def probe(scene: Scene, comm: Comm, steps: int = 5,
          closure: Callable[[SpectralGrid], Closure | None] = lambda grid: None) -> Speed:
    """The speed of the ranks at hand, from a few steps of the scene's fluid with a closure or none; all ranks call it.

    The grid has no more cells a rank than PROBE_CELLS^3.
    """
    small = small_flow(scene, comm.size)
    fluid, clock = build_fluid(small, comm), Clock(end=small.time.duration)
    grid, stepper, state = fluid.grid, STEPPERS[scene.time.stepper](fluid), initial_state(small, fluid)
    step, fluid.closure = build_step_limit(small, grid)(state, clock), closure(grid)

    def advanced(state: np.ndarray) -> np.ndarray:
        if fluid.closure is not None:
            fluid.closure.begin_step(state[:3])
        return stepper(state, step)

    state = advanced(state)  # the first step also plans transforms and makes tables
    times = []
    for _ in range(steps):
        comm.Barrier()
        start = time.perf_counter()
        state = advanced(state)
        comm.Barrier()
        times.append(time.perf_counter() - start)
    seconds, bandwidth = median(times), RANK_BANDWIDTH
    if comm.size > 1:
        exchange = min(exchange_once(grid, small, comm) for _ in range(EVALUATIONS * steps))
        # Ranks of a node may pass messages faster than LATENCY.
        moving = max(exchange - 2 * (comm.size - 1) * LATENCY, exchange / 2)
        bandwidth = sent_bytes(small) * (comm.size - 1) / comm.size**2 / moving
        seconds -= EVALUATIONS * exchange
    history = FlowHistory(fluid)
    history.sample(state, clock)
    clock.tick(step)
    comm.Barrier()
    start = time.perf_counter()
    history.sample(state, clock)
    sample = global_max(comm, time.perf_counter() - start)
    cells = busiest_cells(small, comm.size)
    return Speed(seconds / cells, bandwidth, float(sample) / cells,
                 tracer_seconds(scene, comm) if scene.tracers else 0.0)


def tracer_seconds(scene: Scene, comm: Comm, steps: int = 3) -> float:
    """Seconds in which the tracers of a cell of 64^3 move by a step, on the slowest of the ranks at hand: each by
    itself, all at once, with as many tracers a cell as the scene has."""
    alone, cells = comm.Split(comm.rank), min(scene.flow.cells, PROBE_CELLS)
    try:
        grid = SpectralGrid(SlabDecomposition(alone, BOX_LENGTH, cells), scene.flow.precision)
        state = np.zeros((3, *grid.spectral_shape), grid.complex)
        side = max(round(scene.tracers.particles_per_side * cells / scene.flow.cells), 2)
        field = FilteredField(grid, scene.tracers.filter_width, scene.tracers.interpolation)
        tracers = TracerParticles(field, release(grid.decomposition, scene.seed, side, "random"), state)
        times = []
        for _ in range(steps):
            start = time.perf_counter()
            tracers.advance(state, 0.0)
            times.append(time.perf_counter() - start)
        return float(global_max(comm, min(times))) / cells**3
    finally:
        alone.Free()


def exchange_once(grid: SpectralGrid, scene: Scene, comm: Comm) -> float:
    """Seconds in which the messages of one nonlinear term are sent."""
    to_planes, to_columns = (grid.buffers(direction, components) for direction, components
                             in zip(("backward", "forward"), SENT_COMPONENTS[scene.flow.compressible]))
    comm.Barrier()
    start = time.perf_counter()
    to_planes.to_planes()
    to_columns.to_columns()
    return time.perf_counter() - start


def small_flow(scene: Scene, ranks: int) -> Scene:
    """The flow of a scene with at most PROBE_CELLS^3 cells a rank: random turbulence, forced where the scene is."""
    cells = min(scene.flow.cells, PROBE_CELLS * 2 ** int(math.log(ranks, 8) + 1e-9))
    turbulence, forcing = expected_turbulence(scene), scene.forcing
    initial = Initial(amplitude=turbulence.velocity_rms if turbulence else 1.0, peak_wavenumber=min(3.0, cells / 3))
    if forcing:
        forcing = replace(forcing, wavenumber=min(forcing.wavenumber, cells / 3))
    return replace(scene.without_variants, flow=replace(scene.flow, cells=cells), initial=initial, forcing=forcing,
                   time=replace(scene.time, duration=1.0), spin_up=None, tracers=None, kernel=None, model=None,
                   training=None, simulation=None, eulerian=None)
