"""The Taylor-Green vortex at Re = 1600 against 512^3 points (van Rees et al. 2011). A script, some minutes long.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/taylor_green.py [--cells 64 128] [--output runs/validation]

Dissipation over time is nu <|grad u|^2>, twice the viscosity times the enstrophy; the loss of energy from step to step
is compared with it.
"""

import argparse
import json
from itertools import cycle
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.clock import Clock, ProgressLine
from eddies.flow import initial_fields
from eddies.flow.courant import CourantLimit
from eddies.flow.navier_stokes import IncompressibleFluid
from eddies.flow.statistics import incompressible_budget
from eddies.logs import configure_logging
from eddies.parallel.slab import SlabDecomposition
from eddies.report.figures import DNS, GUIDE, MODEL, SECOND, TRUTH, legend_below, letter, panels, styled
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import ETDRK4

VISCOSITY = 1 / 1600
COURANT, LARGEST_STEP = 0.5, 1 / 32
# Dissipation at these times, and the largest and its time, all as published: 512^3 cells.
REFERENCE = {1.0: 0.000519, 2.0: 0.000708, 3.0: 0.001127, 4.0: 0.002066, 5.0: 0.004127, 6.0: 0.005531}
PEAK_TIME, PEAK = 8.97, 0.012858
ROUNDING = 0.5e-6
AGREEMENT = 0.01  # relative difference up to which a resolution agrees with the reference


def simulate(comm, cells, duration):
    """Time, energy and dissipation at every step, (steps + 1,) each; whole times are among them."""
    grid = SpectralGrid(SlabDecomposition(comm, 2 * np.pi, cells))
    fluid = IncompressibleFluid(grid, VISCOSITY)
    velocity, advance = initial_fields.taylor_green(grid, 1.0), ETDRK4(fluid)
    clock, limit = Clock(), CourantLimit(grid, COURANT, LARGEST_STEP)
    rows = [measure(grid, velocity, clock)]
    progress = ProgressLine(f"{cells}^3", lambda: f"t {clock.time:.2f}  dissipation {rows[-1][2]:.6f}")
    while clock.time < duration:
        clock.end = min(np.floor(clock.time + 1e-9) + 1, duration)
        while clock.running:
            step = limit(velocity, clock)
            velocity = advance(velocity, step)
            clock.tick(step)
            rows.append(measure(grid, velocity, clock))
            progress(clock.time / duration, clock.steps)
        clock.time = clock.end  # but for the round-off of the sum of steps
    return np.array(rows).T


def measure(grid, velocity, clock):
    budget = incompressible_budget(grid, velocity, VISCOSITY)
    return clock.time, budget["total_energy"], budget["dissipation_rate"]


def compare(time, energy, dissipation):
    """Relative differences from the reference at its times, the peak, and the balance of energy."""
    differences = {moment: float(np.interp(moment, time, dissipation) / true - 1)
                   for moment, true in REFERENCE.items() if moment <= time[-1]}
    agreeing = [moment for moment in differences
                if all(abs(differences[earlier]) <= AGREEMENT for earlier in differences if earlier <= moment)]
    lost = energy[0] - energy
    dissipated = np.concatenate([[0], np.cumsum(np.diff(time) * (dissipation[1:] + dissipation[:-1]) / 2)])
    found = {"steps": len(time) - 1, "relative_difference": differences, "agrees_until": max(agreeing, default=0.0),
             "largest_imbalance_of_energy": float(np.max(np.abs(lost - dissipated)) / lost[-1])}
    if time[-1] > PEAK_TIME:
        highest = int(np.argmax(dissipation))
        found |= {"peak": float(dissipation[highest]), "peak_time": float(time[highest]),
                  "relative_difference_of_peak": float(dissipation[highest] / PEAK - 1)}
    return found


@styled
def draw(series, found, path):
    """Dissipation over time with the reference marked, and the relative differences from it."""
    figure, axes = panels(1, 2, (4.4, 3.3))
    left, right = axes.flat
    times, values = np.array(list(REFERENCE)), np.array(list(REFERENCE.values()))
    left.plot([*times, PEAK_TIME], [*values, PEAK], "o", color=DNS, markersize=5, zorder=3, label="$512^3$ (reference)")
    for (cells, (time, _, dissipation)), colour in zip(series.items(), cycle((MODEL, TRUTH, SECOND))):
        differences = found[cells]["relative_difference"]
        left.plot(time, dissipation, color=colour, label=f"${cells}^3$")
        right.semilogy(differences.keys(), np.abs([*differences.values()]), "o-", color=colour, label=f"${cells}^3$")
        if "peak" in found[cells]:
            right.plot(PEAK_TIME, abs(found[cells]["relative_difference_of_peak"]), "*", color=colour, markersize=9)
    right.semilogy(times, ROUNDING / values, color=GUIDE, linestyle="--", linewidth=1.1, label="digits of the $512^3$")
    right.axhline(AGREEMENT, color=GUIDE, linestyle=":", linewidth=1)
    left.set(title="Dissipation", xlabel="time $t$", ylabel=r"$\varepsilon$", ylim=(0, None))
    right.set(title="Difference from the reference (★ of the peak)", xlabel="time $t$",
              ylabel="relative difference")
    legend_below(left, 3)
    legend_below(right, 3)
    letter([left, right])
    figure.savefig(path, dpi=100, facecolor="white", pil_kwargs={"optimize": True})


def table(found):
    """What was found, as Markdown."""
    times = sorted({moment for entry in found.values() for moment in entry["relative_difference"]})
    lines = [f"| cells | {' | '.join(f't = {moment:g}' for moment in times)} | peak (at t) | agrees within "
             f"{AGREEMENT:.0%} until | balance of energy |", "|---" * (len(times) + 4) + "|"]
    for cells, entry in found.items():
        shown = [f"{100 * entry['relative_difference'][moment]:+.2f} %" for moment in times]
        peak = "not reached"
        if "peak" in entry:
            peak = f"{100 * entry['relative_difference_of_peak']:+.2f} % ({entry['peak_time']:.2f})"
        lines.append(f"| {cells}³ | {' | '.join(shown)} | {peak} | t = {entry['agrees_until']:g} "
                     f"| {entry['largest_imbalance_of_energy']:.1e} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, nargs="+", default=[64, 128])
    parser.add_argument("--duration", type=float, default=10.0, help="time up to which the flow is followed")
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    given, comm = parser.parse_args(), MPI.COMM_WORLD
    configure_logging(comm.rank)
    series = {cells: simulate(comm, cells, given.duration) for cells in given.cells}
    if comm.rank == 0:
        given.output.mkdir(parents=True, exist_ok=True)
        found = {cells: compare(*columns) for cells, columns in series.items()}
        names = ("time", "energy", "dissipation")
        content = {"ranks": comm.size, "courant": COURANT, "runs": [
            {"cells": cells, **found[cells],
             **{name: column[::4].round(9).tolist() for name, column in zip(names, columns)}}
            for cells, columns in series.items()]}
        (given.output / "taylor_green.json").write_text(json.dumps(content) + "\n")
        draw(series, found, given.output / "taylor_green.png")
        print(table(found))


if __name__ == "__main__":
    main()
