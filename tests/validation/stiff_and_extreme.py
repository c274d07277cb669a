"""Stiff and extreme flows: what should happen, and what happens. A script, some seconds long.

    python tests/validation/stiff_and_extreme.py [--output runs/validation]

Prints a table and writes it as stiff_and_extreme.json.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mpi4py import MPI

from test_stiff_and_extreme import (
    ODD_GRIDS, TIME_STEPS, TOO_LONG, VISCOSITIES, diverging_scene, error_of_ranks, inviscid_energy_error,
    one_wavevector_error, run_at_mach_number, shear_wave_error, single_precision_error,
)

from eddies.flow.stability import FlowDiverged
from eddies.time_stepping import STEPPERS
from eddies.workflows import dns


def cases(comm) -> Iterator[tuple[str, str, str]]:
    """What is done, what should happen, what happens."""
    for mach in (0.01, 0.5):
        run = run_at_mach_number(comm, mach)
        yield (f"M_t {mach:g}, 24^3 cells, time 0.25", "10 steps for both, energy budget to 1e-3",
               f"{run.clock.steps} steps, budget error {run.history.budget_error:.1e}")
    for fluid in ("incompressible", "compressible"):
        errors = [shear_wave_error(comm, fluid, nu, step) for nu in VISCOSITIES for step in TIME_STEPS]
        yield (f"shear wave, {fluid}, viscosity {VISCOSITIES[0]:g} to {VISCOSITIES[-1]:g}, step {TIME_STEPS[0]:g} to "
               f"{TIME_STEPS[-1]:g}", "exact at any step", f"largest error {max(errors):.1e}")
    for stepper in STEPPERS:
        coarse, fine = (inviscid_energy_error(comm, stepper, step) for step in (0.05, 0.025))
        yield (f"no viscosity, {stepper}, steps 0.05 and 0.025, time 0.5", "energy is lost as step^5",
               f"relative {coarse:.1e} and {fine:.1e}, order {np.log2(coarse / fine):.2f}")
    for index, cutoff in (((0, 1, -1), 1), ((2, 2, 2), 2)):
        yield (f"one wavevector {index}, k_max {cutoff}, 8^3 cells", "decays exactly",
               f"relative error {one_wavevector_error(comm, index, cutoff):.1e}")
    for cells in ODD_GRIDS:
        yield (f"{cells}^3 cells, forced, on {comm.size} ranks", "as on one rank",
               f"largest difference {error_of_ranks(comm, cells):.1e}")
    for count in (1, 20, 80):
        yield (f"float32, {count} steps, 16^3 cells", "float64 but for a round-off of 6e-8 a few times, growing",
               f"relative difference {single_precision_error(comm, count):.1e}")
    for limit in TOO_LONG:
        yield f"step too long: {limit}", "ends at once and names the limit", divergence(comm, limit)


def divergence(comm, limit: str) -> str:
    """What a run says that breaks a limit."""
    with tempfile.TemporaryDirectory() as folder:
        try:
            dns.run(diverging_scene(limit), comm, comm.bcast(folder))
            return "nothing"
        except FlowDiverged as told:
            return str(told)
        finally:
            comm.Barrier()


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    output, comm = parser.parse_args().output, MPI.COMM_WORLD
    rows = [dict(zip(("case", "expected", "found"), row)) for row in cases(comm)]
    if comm.rank == 0:
        output.mkdir(parents=True, exist_ok=True)
        (output / "stiff_and_extreme.json").write_text(json.dumps(rows, indent=1))
        for row in rows:
            print(*row.values(), sep="  |  ")


if __name__ == "__main__":
    main()
