"""Time of an ETDRK4 step of the compressible fluid and of its parts, each against a bound measured in the same run.

    mpirun -n 2 .venv/bin/python tests/benchmarks/step.py [CELLS ...] [--precision float32] [--share-of RANKS]

Times of parts are means over the ranks and medians over the steps. A part that waits for another rank includes the
wait. Below the table a JSON line has the median time of a step, without the first.

Bounds: the same transforms by FFTW alone, in cache; the bytes that a rank sends, divided by the bandwidth in a ring of
the ranks; for pointwise work the bytes of the input and output arrays, each moved once, divided by the bandwidth of a
triad a = b + c, with arrays of the same size as a call's or, for whole states, larger than all caches.

`--share-of` runs the share of the first of many ranks, without the others, whose messages are zero. It measures work
and memory of a rank for a grid that is too large for this machine.
"""

import argparse
import functools
import json
import resource
import time
from collections import Counter
from collections.abc import Callable, Iterable
from statistics import median

import numpy as np
from mpi4py import MPI

from eddies.flow.initial_fields import balanced_density, random_velocity
from eddies.flow.navier_stokes import CompressibleFluid
from eddies.kernels.copies import PlaneCopies
from eddies.parallel.slab import SlabDecomposition, Transpose
from eddies.spectral.fourier_passes import PlanePass
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import ETDRK4

EVALUATIONS = 4              # of the nonlinear term in a step
BACKWARD, SENT, FORWARD = 15, 8, 4  # transforms of an evaluation: back, of these the sent ones, and forth
RING_BYTES, RING_ROUNDS = 2**23, 10
TRIAD_BYTES = 2**25          # size of an array that no cache holds
# Functions of each part, by owner and name. A call within a call of another part counts for the inner part only.
PARTS = {
    "plane transforms": [(PlanePass, "to_physical"), (PlanePass, "to_modes")],
    "column transforms": [(SpectralGrid, "_columns_to_planes"), (SpectralGrid, "_planes_to_columns")],
    "transposes": [(Transpose, "to_planes"), (Transpose, "to_columns")],
    "pairs of planes": [(PlaneCopies, "pack"), (PlaneCopies, "unpack")],
    "products": [(CompressibleFluid, "_advection")],
    "linear operators": [(CompressibleFluid, "combine")],
}


class Stopwatch:
    """Seconds, calls and bytes in and out of each part; all other time is "the rest"."""

    def __init__(self) -> None:
        self.open, self.last = ["the rest"], time.perf_counter()
        self.reset()

    def reset(self) -> None:
        """Set all counters to zero."""
        self.seconds, self.calls, self.bytes = Counter(), Counter(), Counter()

    def switch(self) -> None:
        """Add the time since the last switch to the open part."""
        now = time.perf_counter()
        self.seconds[self.open[-1]] += now - self.last
        self.last = now

    def wrap(self, owner: object, name: str, part: str) -> None:
        """Count calls of `owner.name` for `part`."""
        function = getattr(owner, name)

        @functools.wraps(function)
        def measured(*arguments):
            self.switch()
            self.open.append(part)
            result = function(*arguments)
            self.switch()
            self.open.pop()
            self.calls[part] += 1
            self.bytes[part] += sum(array.nbytes for array in arrays_in((arguments, result)))
            self.last = time.perf_counter()
            return result

        setattr(owner, name, measured)


def arrays_in(items: object) -> Iterable[np.ndarray]:
    """Yield the arrays among arguments or results."""
    if isinstance(items, np.ndarray):
        yield items
    elif isinstance(items, (tuple, list)):
        for item in items:
            yield from arrays_in(item)


class FirstOf:
    """Communicator of the first of `size` ranks; the others send zeros and add nothing."""

    rank = 0

    def __init__(self, size: int) -> None:
        self.size, self._zeroed = size, set()

    def Alltoallv(self, sent: list, received: list) -> None:
        if id(received[0]) not in self._zeroed:
            self._zeroed.add(id(received[0]))
            received[0][:] = 0

    def Allreduce(self, *arguments: object, op: MPI.Op) -> None:
        pass


def best(action: Callable[[], object], repeats: int = 7) -> float:
    """The shortest of several times of an action."""
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        times.append(time.perf_counter() - start)
    return min(times)


def in_turn(actions: dict[str, Callable[[], object]], rounds: int = 9) -> dict[str, float]:
    """Median seconds of each action. They are measured in turn, so that all meet the same disturbances."""
    seconds: dict[str, list[float]] = {name: [] for name in actions}
    for _ in range(rounds + 1):
        for name, action in actions.items():
            start = time.perf_counter()
            action()
            seconds[name].append(time.perf_counter() - start)
    return {name: median(times[1:]) for name, times in seconds.items()}  # the first call also fills caches


def triad_bandwidth(size: int) -> float:
    """Bytes per second that a rank reads and writes in a = b + c with arrays of `size` bytes."""
    a, b, c = np.ones((3, size // 8))
    rounds = max(1, 2**26 // size)

    def triad() -> None:
        for _ in range(rounds):
            np.add(b, c, out=a)

    return 3 * size * rounds / best(triad)


def ring_bandwidth(comm: MPI.Comm) -> float:
    """Bytes per second that a rank sends to the next while it receives as many."""
    outgoing, incoming = np.ones(RING_BYTES, np.uint8), np.zeros(RING_BYTES, np.uint8)
    above, below = (comm.rank + 1) % comm.size, (comm.rank - 1) % comm.size

    def ring() -> None:
        for _ in range(RING_ROUNDS):
            comm.Sendrecv(outgoing, above, 0, incoming, below, 0)

    return RING_ROUNDS * RING_BYTES / best(ring)


def transform_bounds(grid: SpectralGrid, backward: int, sent: int, forward: int) -> dict[str, float]:
    """Seconds of transforms by FFTW alone; of the `backward` components, `sent` are also transformed along z."""
    count, planes = grid.decomposition.count, 0.0
    for direction, components in (("BACKWARD", backward), ("FORWARD", forward)):
        for block in grid.plane_pass.blocks(count):
            plans = grid.plane_pass.plans(direction, components, block).plans
            planes += best(lambda: [plan.execute() for of_field in plans for plan in of_field])
    columns = 0.0
    for direction, components in (("BACKWARD", sent), ("FORWARD", forward)):
        for rows in grid.column_pass.rows(grid.spectral_shape[1]):
            columns += components * best(grid.column_pass.plan(direction, rows).plan.execute)
    return {"plane transforms": planes, "column transforms": columns}


def sent_bytes(grid: SpectralGrid) -> int:
    """Bytes that a rank sends in a step."""
    return EVALUATIONS * sum(lines.nbytes for lines in (grid._batch("backward", SENT).transpose._columns,
                                                        grid._batch("forward", FORWARD).transpose._planes))


def measure(comm: MPI.Comm, watch: Stopwatch, cells: int, precision: str, steps: int, share_of: int) -> dict:
    """Seconds of a step and of its parts, their bounds, and the largest memory of a rank so far."""
    over = FirstOf(share_of) if share_of else comm
    grid = SpectralGrid(SlabDecomposition(over, 2 * np.pi, cells), precision)
    fluid = CompressibleFluid(grid, 1.2 / cells**(4 / 3), sound_speed=22.7)
    velocity = random_velocity(grid, 1, 1.0, 3.0)
    state = np.concatenate([velocity, balanced_density(grid, velocity, fluid.sound_speed)[None]])
    stepper, step, totals, parts = ETDRK4(fluid), 0.8 / cells, [], []
    state = stepper(state, step)  # the first step also plans transforms and makes tables
    for _ in range(steps):
        comm.Barrier()
        watch.switch()
        watch.reset()
        start = time.perf_counter()
        state = stepper(state, step)
        watch.switch()
        parts.append(dict(watch.seconds))
        comm.Barrier()
        totals.append(time.perf_counter() - start)
    if not np.isfinite(state).all():
        raise FloatingPointError(f"{cells}^3, {precision}: the benchmark's flow is no longer finite")
    seconds = {part: comm.allreduce(median(step.get(part, 0.0) for step in parts)) / comm.size
               for part in [*PARTS, "the rest"]}
    memory = comm.allreduce(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, MPI.MAX)
    bounds = {part: EVALUATIONS * bound for part, bound in transform_bounds(grid, BACKWARD, SENT, FORWARD).items()}
    block = watch.bytes["products"] // (3 * watch.calls["products"])
    bounds["products"] = watch.bytes["products"] / triad_bandwidth(block)
    bounds["linear operators"] = watch.bytes["linear operators"] / triad_bandwidth(TRIAD_BYTES)
    if comm.size > 1:
        bounds["transposes"] = sent_bytes(grid) / ring_bandwidth(comm)
    bounds = {part: comm.allreduce(bound) / comm.size for part, bound in bounds.items()}
    return {"cells": cells, "precision": precision, "ranks": comm.size, "share_of": share_of,
            "seconds_per_step": median(totals), "parts": seconds, "bounds": bounds, "memory_bytes": 1024 * memory}


def table(result: dict) -> str:
    """A result as text."""
    alone = f", the share of one of {result['share_of']}" if result["share_of"] else ""
    step = result["seconds_per_step"]
    lines = [f"{result['cells']}^3 {result['precision']}, {result['ranks']} ranks{alone}: {step:.4f} s a step, at most "
             f"{result['memory_bytes'] / 1e6:.0f} MB a rank so far",
             f"    {'part':18} {'seconds':>9} {'share':>7} {'bound':>9} {'ratio':>6}"]
    for part, seconds in result["parts"].items():
        line = f"    {part:18} {seconds:9.4f} {seconds / step:7.1%}"
        bound = result["bounds"].get(part, 0.0)
        lines.append(line + (f" {bound:9.4f} {seconds / bound:6.2f}" if bound else ""))
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cells", nargs="*", type=int, default=[64, 128])
    parser.add_argument("--precision", nargs="+", choices=["float64", "float32"], default=["float64", "float32"])
    parser.add_argument("--steps", type=int, default=7)
    parser.add_argument("--share-of", type=int, default=0, metavar="RANKS", help="run one rank's share alone")
    options = parser.parse_args()
    comm, watch = MPI.COMM_WORLD, Stopwatch()
    for part, functions in PARTS.items():
        for owner, name in functions:
            watch.wrap(owner, name, part)
    for cells in options.cells:
        for precision in options.precision:
            result = measure(comm, watch, cells, precision, options.steps, options.share_of)
            if comm.rank == 0:
                print(table(result))
                print(json.dumps({key: result[key] for key in ("cells", "precision", "ranks", "seconds_per_step")}),
                      flush=True)


if __name__ == "__main__":
    main()
