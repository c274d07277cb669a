"""Time of one iteration of the closure's conjugate gradients, and of its parts.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/benchmarks/closure_iteration.py [PARTICLES A SIDE]
        [--precision float64]

Random particles on a grid of 1.75 planes per particle, modes up to 1.5 times their Nyquist wavenumber, by default in
single precision, as in a rollout. Prints a JSON line with the median seconds of the slowest rank.
"""

import argparse
import json
import math
import time
from collections.abc import Callable
from statistics import median

import numpy as np
import torch
from mpi4py import MPI

from eddies.parallel.slab import SlabDecomposition
from eddies.particles.fourier_grid import FourierGrid
from eddies.particles.resolved_velocity import ResolvedVelocity

PLANES, HIGHEST, REPEATS, ITERATIONS = 1.75, 0.75, 9, 4


def seconds(comm: MPI.Comm, action: Callable[[], object]) -> float:
    """Median time of an action that all ranks start together; each time is that of the slowest rank."""
    times = []
    for _ in range(REPEATS + 1):
        comm.Barrier()
        start = time.perf_counter()
        action()
        times.append(comm.allreduce(time.perf_counter() - start, MPI.MAX))
    return median(times[1:])


def measure(comm: MPI.Comm, side: int, dtype: torch.dtype) -> dict[str, float]:
    """Seconds of each part of an iteration."""
    slab = SlabDecomposition(comm, 2 * math.pi, int(PLANES * side))
    grid, random = FourierGrid(slab, int(HIGHEST * side), 1, dtype), np.random.default_rng(1)
    position, velocity = random.uniform(0, slab.length, (side**3, 3)), random.standard_normal((side**3, 3))
    own = (position[:, 2] >= slab.lower) & (position[:, 2] < slab.upper)
    velocity, points = torch.from_numpy(velocity[own]), grid.points(torch.from_numpy(position[own]))
    equations = ResolvedVelocity(grid, 2 * slab.length / side).equations
    right = equations.gathered(velocity, points)
    fields = grid.to_fields(right * grid.prefilter)
    inverse, found, residual = (equations.preconditioner(side**3).numpy(), *(right.numpy().copy() for _ in range(2)))
    passes = equations._passes

    def vectors() -> None:
        image, _ = passes.image(right.numpy(), found)
        passes.descend(1e-9, inverse, image, right.numpy(), found, residual)
        passes.turn(1e-9, inverse, residual, found)

    actions = {
        "places": lambda: points.spline.around(points.position.numpy()),
        "iteration": lambda: equations.solve(points, right, side**3, 0.0, ITERATIONS, ITERATIONS),
        "interpolation": lambda: points.at(points.spline.with_ghosts(fields.numpy())),
        "spreading": lambda: points.spread(velocity),
        "transforms": lambda: (grid.to_fields(right), grid.to_modes(fields)),
        "vectors": vectors,
        "spline coefficients": lambda: right * grid.prefilter,
    }
    found_seconds = {name: seconds(comm, action) for name, action in actions.items()}
    return {**found_seconds, "iteration": found_seconds["iteration"] / ITERATIONS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("side", nargs="?", type=int, default=64)
    parser.add_argument("--precision", choices=("float32", "float64"), default="float32")
    options, comm = parser.parse_args(), MPI.COMM_WORLD
    torch.set_num_threads(1)
    with torch.no_grad():
        found = measure(comm, options.side, getattr(torch, options.precision))
    if comm.rank == 0:
        rate = {name: options.side**3 / found[name] for name in ("interpolation", "spreading")}
        print(json.dumps({"particles": options.side, "ranks": comm.size, "precision": options.precision,
                          "seconds": found, "points_per_second": rate}))


if __name__ == "__main__":
    main()
