"""Error against run time of the time steppers at three Mach numbers. Takes minutes.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/steppers.py [--cells 48] [--output runs/validation]

Developed turbulence decays for half a turnover, from the same state with each stepper, with steps from beyond its limit
of stability down. Errors at the end are relative to ETDRK4 with a fine step. Prints a table and writes steppers.png.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from flows import make_grid, march, with_density
from mpi4py import MPI

from eddies.analysis.errors import normalized_l2
from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid, advective_speed
from eddies.flow.stability import IMAGINARY_REACH
from eddies.flow.statistics import energy_spectrum, gradient_moments
from eddies.parallel.reduction import global_max
from eddies.report.figures import BLUE, MODEL, letter, panels, styled
from eddies.time_stepping import ETDRK4, STEPPERS

MACH_NUMBERS, DURATION, SKEWNESS = (0.04, 0.08, 0.16), 0.5, -0.4  # the start has developed at this skewness
# Steps in parts of the theoretical limit of stability; the shortest of ETDRK4 is the reference.
PARTS = {"rk4": (2.0, 0.95, 0.95 / 2, 0.95 / 4), "etdrk4": (2.0, 0.95, 0.95 / 2, 0.95 / 4, 0.95 / 8, 0.95 / 32)}
QUANTITIES = ("density", "spectrum", "velocity")


def largest_speed(grid, state):
    return float(global_max(grid.decomposition.comm, advective_speed(grid, state[:3])))


def power(grid, modes):
    return grid.sum_modes((np.abs(modes) ** 2).sum(axis=0))


def developed_flows(grid):
    """A fluid and a state for each Mach number, from the same random velocity after the same time."""
    viscosity = 0.0135 * (21 / grid.cutoff) ** (4 / 3)  # k_max eta is about 1
    start = initial_fields.random_velocity(grid, 1, 1.0, 3.0)
    step = 0.6 * grid.decomposition.spacing / largest_speed(grid, start)
    velocity, count = start, 0
    advance = ETDRK4(IncompressibleFluid(grid, viscosity))
    while gradient_moments(grid, velocity)[0] > SKEWNESS and count * step < 1.0:
        velocity, count = advance(velocity, step), count + 1
    speed = np.sqrt(power(grid, velocity))  # that of the compressible flows differs by M_t^2
    for mach in MACH_NUMBERS:
        fluid = CompressibleFluid(grid, viscosity, speed / mach)
        yield mach, fluid, march(fluid, with_density(grid, start, fluid.sound_speed), step, count)


def errors(grid, state, reference):
    """Relative L2 differences of density fluctuation, energy spectrum and velocity."""
    spectra = [energy_spectrum(grid, velocity[:3])[1:grid.cutoff + 1] for velocity in (state, reference)]
    found, true = (np.exp(grid.backward(values[3:])) for values in (state, reference))
    density = grid.mean((found - true) ** 2) / grid.mean((true - grid.mean(true)) ** 2)
    velocity = power(grid, (state - reference)[:3]) / power(grid, reference[:3])
    return dict(zip(QUANTITIES, (float(np.sqrt(density[0])), normalized_l2(*spectra), float(np.sqrt(velocity)))))


def study(fluid, start):
    """Runs of all steps of all steppers: stepper, step, seconds per unit of time, and errors unless unstable."""
    grid, comm = fluid.grid, fluid.grid.decomposition.comm
    advection = largest_speed(grid, start) * grid.cutoff
    speeds = {"etdrk4": advection, "rk4": advection + fluid.sound_speed * np.sqrt(3) * grid.cutoff}
    runs = []
    for stepper, parts in PARTS.items():
        for part in parts:
            count = int(np.ceil(DURATION / (part * IMAGINARY_REACH / speeds[stepper])))
            advance = STEPPERS[stepper](fluid)
            state, before = advance(start, DURATION / count), power(grid, start[:3])  # prepares plans and operators
            state, longest = start, count if part < 1 else 4 * count  # to show that it is unstable
            comm.Barrier()
            began = time.perf_counter()
            for _ in range(longest):
                state = advance(state, DURATION / count)
                if not power(grid, state[:3]) < 4 * before:
                    break
            seconds = (time.perf_counter() - began) / DURATION
            stable = part < 1 and power(grid, state[:3]) < 4 * before
            runs.append({"stepper": stepper, "step": DURATION / count, "seconds": comm.bcast(seconds),
                         "end": state if stable else None})
    reference = runs[-1]["end"]
    for run in runs:
        end = run.pop("end")
        run |= {} if end is None else errors(grid, end, reference)
    return runs


@styled
def draw(found, path):
    """Errors of density and spectrum over cost, a panel for each Mach number."""
    figure, axes = panels(1, len(found), (3.25, 3.2), sharex=True, sharey=True)
    figure.set_layout_engine("constrained")  # for labels and legends that are wide
    for (mach, runs), axis in zip(found.items(), axes.flat):
        for stepper, colour, marker in (("etdrk4", BLUE, "o"), ("rk4", MODEL, "s")):
            stable = [run for run in runs[:-1] if run["stepper"] == stepper and "density" in run]
            for quantity, style in (("density", "-"), ("spectrum", "--")):
                axis.loglog([run["seconds"] for run in stable], [run[quantity] for run in stable], style, color=colour,
                            marker=marker, markersize=5, label=f"{stepper.upper()}, {quantity}")
        axis.set_title(f"$M_t = {mach:g}$")
    axes[0, 0].set(ylabel="relative error", ylim=(None, 1))
    axes[0, 1].set_xlabel("wall seconds per unit of time")
    letter(axes.flat)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=100, facecolor="white", pil_kwargs={"optimize": True})


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=48)
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    given, comm = parser.parse_args(), MPI.COMM_WORLD
    with np.errstate(over="ignore", invalid="ignore"):
        found = {mach: study(fluid, start) for mach, fluid, start in developed_flows(make_grid(comm, given.cells))}
    if comm.rank == 0:
        given.output.mkdir(parents=True, exist_ok=True)
        draw(found, given.output / "steppers.png")
        for mach, runs in found.items():
            for run in runs:
                shown = [f"{quantity} {run[quantity]:.2e}" for quantity in QUANTITIES if quantity in run]
                print(f"M_t {mach:g}  {run['stepper']:6}  step {run['step']:.5f}  {run['seconds']:.3g} s  ",
                      *(shown or ["unstable"]))


if __name__ == "__main__":
    main()
