"""Dissipation of the Taylor-Green vortex at Re = 1600 against 512^3 points (van Rees et al. 2011). Takes minutes.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/taylor_green.py [--cells 64 128]

Prints the relative differences at the times of the reference, the peak, and the imbalance between the loss of energy
and the dissipation nu <|grad u|^2>.
"""

import argparse

import numpy as np
from flows import make_grid
from mpi4py import MPI

from eddies.clock import Clock
from eddies.flow import initial_fields
from eddies.flow.stability import CourantLimit
from eddies.flow.navier_stokes import IncompressibleFluid
from eddies.flow.statistics import incompressible_budget
from eddies.time_stepping import ETDRK4

VISCOSITY, COURANT, LARGEST_STEP = 1 / 1600, 0.5, 1 / 32
# Published dissipation at these times, and the largest with its time.
REFERENCE = {1.0: 0.000519, 2.0: 0.000708, 3.0: 0.001127, 4.0: 0.002066, 5.0: 0.004127, 6.0: 0.005531}
PEAK_TIME, PEAK = 8.97, 0.012858


def simulate(comm, cells, duration):
    """Time, energy and dissipation at every step, (steps + 1,) each; whole times are among them."""
    grid = make_grid(comm, cells)
    fluid = IncompressibleFluid(grid, VISCOSITY)
    velocity, advance, rows = initial_fields.taylor_green(grid, 1.0), ETDRK4(fluid), []
    clock, limit = Clock(), CourantLimit(grid, COURANT, LARGEST_STEP)
    while True:
        budget = incompressible_budget(grid, velocity, VISCOSITY)
        rows.append((clock.time, budget["total_energy"], budget["dissipation_rate"]))
        if clock.time >= duration - 1e-9:
            return np.array(rows).T
        clock.span = min(np.floor(clock.time + 1e-9) + 1, duration)
        step = limit(velocity, clock)
        velocity = advance(velocity, step)
        clock.tick(step)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--duration", type=float, default=10.0, help="time up to which the flow is followed")
    given, comm = parser.parse_args(), MPI.COMM_WORLD
    for cells in given.cells:
        time, energy, dissipation = simulate(comm, cells, given.duration)
        differences = [f"t = {moment:g}: {np.interp(moment, time, dissipation) / true - 1:+.2%}"
                       for moment, true in REFERENCE.items() if moment <= time[-1]]
        highest = np.argmax(dissipation)
        lost = energy[0] - energy
        dissipated = np.concatenate([[0], np.cumsum(np.diff(time) * (dissipation[1:] + dissipation[:-1]) / 2)])
        if comm.rank == 0:
            print(f"{cells}^3:", ", ".join(differences), f"; peak {dissipation[highest] / PEAK - 1:+.2%} at t = "
                  f"{time[highest]:.2f} (reference {PEAK_TIME}); imbalance of energy "
                  f"{np.max(np.abs(lost - dissipated)) / lost[-1]:.1e}", flush=True)


if __name__ == "__main__":
    main()
