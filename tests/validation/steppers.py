"""Error against run time of the time steppers at three Mach numbers. A script, some minutes long.

    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/steppers.py [--cells 48] [--output runs/validation]

Turbulence that has developed from a random start decays for half a turnover, from the same state by each stepper with
steps from its largest stable one down. Errors are those at the end, relative to ETDRK4 with a fine step; RK4 with its
finest step tells how far that reference can be trusted.
"""

import argparse
import json
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from mpi4py import MPI

from eddies.analysis.errors import normalized_l2
from eddies.clock import ProgressLine
from eddies.flow import initial_fields
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid, advective_speed
from eddies.flow.statistics import compressible_budget, energy_spectrum, gradient_moments, turbulence_scales
from eddies.logs import configure_logging
from eddies.parallel.reduction import global_max
from eddies.parallel.slab import SlabDecomposition
from eddies.report.figures import MODEL, TRUTH, letter, number_wavenumbers, panels, styled
from eddies.spectral.spectral_grid import SpectralGrid
from eddies.time_stepping import ETDRK4, STEPPERS

MACH_NUMBERS = (0.04, 0.08, 0.16)
DURATION = 0.5           # about half a turnover
SKEWNESS = -0.4          # of the longitudinal gradient, where the start counts as developed
STABLE = 2 * np.sqrt(2)  # RK4 on the imaginary axis; ETDRK4 too, of what it treats explicitly
# Steps in parts of the theoretical limit of stability: beyond it, just below, and halved.
EXPONENTIAL, REFERENCE = (2.0, 0.95, 0.95 / 2, 0.95 / 4, 0.95 / 8), 0.95 / 32
EXPLICIT, FINEST = (2.0, 0.95, 0.95 / 2, 0.95 / 4), DURATION / 250
LONGER = 4  # times the duration, which steps beyond the limit get to show that they are unstable
QUANTITIES = {"density": "density", "pressure": "pressure of the vortices", "spectrum": "energy spectrum",
              "velocity": "velocity"}
TOLERANCES = (1e-1, 1e-2, 1e-3, 1e-4, 1e-5)


@dataclass
class Flow:
    """A developed flow at a nominal Mach number, and what was found of the steppers in it."""

    mach: float
    fluid: CompressibleFluid
    state: np.ndarray
    numbers: dict = field(default_factory=dict)
    runs: list = field(default_factory=list)


def developed_flows(grid):
    """One flow for each Mach number, from the same random velocity after the same time."""
    viscosity = 0.0135 * (21 / grid.cutoff) ** (4 / 3)  # k_max eta is about 1
    start = initial_fields.random_velocity(grid, 1, 1.0, 3.0)
    step = 0.6 * grid.decomposition.spacing / largest_speed(grid, start)
    velocity, count = start, 0
    advance = ETDRK4(IncompressibleFluid(grid, viscosity))
    while gradient_moments(grid, velocity)[0] > SKEWNESS and count * step < 1.0:
        velocity, count = advance(velocity, step), count + 1
    speed = np.sqrt(2 * kinetic_energy(grid, velocity))  # that of the compressible flows differs by M_t^2
    for mach in MACH_NUMBERS:
        fluid = CompressibleFluid(grid, viscosity, speed / mach)
        state = np.concatenate([start, initial_fields.balanced_density(grid, start, fluid.sound_speed)[None]])
        advance = ETDRK4(fluid)
        for _ in range(count):
            state = advance(state, step)
        yield Flow(mach, fluid, state, numbers=describe(fluid, state))


def describe(fluid, state):
    """Scales of a flow, and how much of its density fluctuation is sound: not the pressure of its vortices."""
    grid, c = fluid.grid, fluid.sound_speed
    budget = compressible_budget(grid, state, fluid.viscosity, c)
    scales = turbulence_scales(energy_spectrum(grid, state[:3])[1], budget["dissipation_rate"], fluid.viscosity,
                               grid.cutoff)
    balanced = vortex_density(fluid, state)
    return {"mach_measured": np.sqrt(2 * kinetic_energy(grid, state)) / c, "sound_speed": c,
            "viscosity": fluid.viscosity, "skewness": budget["skewness"], "density_rms": budget["density_rms"],
            "sound_share": np.sqrt(power(grid, state[3] - balanced) / power(grid, state[3])),
            **{name: scales[name] for name in ("reynolds_lambda", "kmax_eta", "eddy_turnover_time")}}


def vortex_density(fluid, state):
    """s = ln(rho / rho_0) as the pressure of the solenoidal velocity makes it, without sound."""
    return initial_fields.balanced_density(fluid.grid, fluid.grid.solenoidal(state[:3]), fluid.sound_speed)


def kinetic_energy(grid, state):
    return 0.5 * sum(power(grid, component) for component in state[:3])


def power(grid, modes):
    return grid.sum_modes(np.abs(modes) ** 2)


def largest_speed(grid, state):
    return float(global_max(grid.decomposition.comm, advective_speed(grid, state[:3])))


def ladders(flow):
    """Numbers of steps of each stepper, the largest steps first, and of the reference."""
    grid = flow.fluid.grid
    advection = largest_speed(grid, flow.state) * grid.cutoff
    limits = {"etdrk4": STABLE / advection,
              "rk4": STABLE / (advection + flow.fluid.sound_speed * np.sqrt(3) * grid.cutoff)}
    parts = {"etdrk4": [*EXPONENTIAL, REFERENCE], "rk4": list(EXPLICIT)}
    while limits["rk4"] * parts["rk4"][-1] > FINEST:
        parts["rk4"].append(parts["rk4"][-1] / 2)
    flow.numbers["largest_stable_step"] = limits
    return [(name, part, int(np.ceil(DURATION / (part * limit))))
            for name, limit in limits.items() for part in parts[name]]


def march(name, flow, count, longest):
    """The state after `count` steps of the duration, and the time at which the flow had four times its energy, if that
    happens in `longest` steps."""
    advance, state, grid, end = STEPPERS[name](flow.fluid), flow.state, flow.fluid.grid, None
    bound = 4 * kinetic_energy(grid, state)
    with np.errstate(over="ignore", invalid="ignore"):
        for number in range(1, longest + 1):
            state = advance(state, DURATION / count)
            if not kinetic_energy(grid, state) < bound:
                return end, DURATION * number / count
            if number == count:
                end = state
    return end, None


def study(flow, number, progress):
    """Run all steps of all steppers in a flow, the `number`-th one, and keep their errors."""
    ends, planned = [], ladders(flow)
    total, steps = sum(count for _, _, count in planned), 0
    for name, part, count in planned:
        end, failed_at = march(name, flow, count, count if part < 1 else LONGER * count)
        steps += count
        progress((number + steps / total) / len(MACH_NUMBERS), number * total + steps)
        ends.append(end)
        flow.runs.append({"stepper": name, "part_of_limit": part, "steps": count, "step": DURATION / count,
                          "reference": (name, part) == ("etdrk4", REFERENCE), "failed_at": failed_at})
    reference = ends[[run["reference"] for run in flow.runs].index(True)]
    for run, end in zip(flow.runs, ends):
        run |= errors(flow.fluid, end, reference) if run["failed_at"] is None else dict.fromkeys(QUANTITIES)


def errors(fluid, state, reference):
    """Relative L2 differences of density fluctuation, its part that is no sound, energy spectrum and velocity."""
    grid = fluid.grid
    spectra = [energy_spectrum(grid, velocity[:3])[1][1:grid.cutoff + 1] for velocity in (state, reference)]
    found, true = (np.exp(grid.backward(values[3:])) for values in (state, reference))
    fluctuation = grid.mean((true - grid.mean(true)) ** 2)
    pressure = power(grid, vortex_density(fluid, state) - vortex_density(fluid, reference)) / fluctuation
    velocity = kinetic_energy(grid, state - reference) / kinetic_energy(grid, reference)
    return {"density": float(np.sqrt(grid.mean((found - true) ** 2) / fluctuation)[0]),
            "pressure": float(np.sqrt(pressure)[0]), "velocity": float(np.sqrt(velocity)),
            "spectrum": normalized_l2(*spectra)}


def measure_cost(flows, repeats=9, steps=3):
    """Wall seconds per unit of simulated time of each run: the median of interleaved repeats of a few steps.

    All steps of a stepper do the same work, whatever the Mach number.
    """
    comm, seconds = flows[0].fluid.grid.decomposition.comm, {name: [] for name in STEPPERS}
    cases = [(flow, name, STEPPERS[name](flow.fluid)) for flow in flows for name in STEPPERS]
    for repeat in range(repeats + 1):  # the first warms up
        for flow, name, advance in cases:
            step, state = 0.5 * flow.numbers["largest_stable_step"][name], flow.state
            comm.Barrier()
            begin = time.perf_counter()
            for _ in range(steps):
                state = advance(state, step)
            comm.Barrier()
            if repeat:
                seconds[name].append((time.perf_counter() - begin) / steps)
    for flow in flows:
        flow.numbers["seconds_per_step"] = {name: float(np.median(seconds[name])) for name in STEPPERS}
        for run in flow.runs:
            run["seconds"] = flow.numbers["seconds_per_step"][run["stepper"]] / run["step"]


def conclude(flow):
    """Trust in the reference, observed orders, and how many times more RK4 costs for the same error."""
    flow.numbers["reference_against_rk4"] = {quantity: flow.runs[-1][quantity] for quantity in QUANTITIES}
    flow.numbers["orders"] = {f"{quantity}, {name}": [round(order, 2) for order in orders(flow, name, quantity)]
                              for quantity in QUANTITIES for name in STEPPERS}
    flow.numbers["cost_of_rk4_over_etdrk4"] = {
        quantity: {f"{error:.0e}": cost_ratio(flow, quantity, error) for error in TOLERANCES}
        for quantity in QUANTITIES}


def stable_runs(flow, name):
    """The runs of a stepper with stable steps, but for the reference; the largest step first."""
    return [run for run in flow.runs if run["stepper"] == name and run["part_of_limit"] < 1 and not run["reference"]]


def orders(flow, name, quantity):
    """Order between each step of a stepper and the next."""
    runs = stable_runs(flow, name)
    return [float(np.log(a[quantity] / b[quantity]) / np.log(a["step"] / b["step"])) for a, b in zip(runs, runs[1:])]


def cost_ratio(flow, quantity, error):
    """How many times more RK4 costs for an error at most so large; None where either was not tried so fine.

    Between the steps tried, costs follow straight lines of logarithms; a larger error is had for the cost of the
    largest stable step.
    """
    logarithm = {}
    for name in STEPPERS:
        runs = stable_runs(flow, name)[::-1]
        found, seconds = (np.log([run[key] for run in runs]) for key in (quantity, "seconds"))
        logarithm[name] = np.interp(np.log(error), found, seconds, left=np.nan)
    ratio = float(np.exp(logarithm["rk4"] - logarithm["etdrk4"]))
    return ratio if np.isfinite(ratio) else None


@styled
def draw(flows, path):
    """Errors of density and spectrum over cost, a panel for each Mach number; unstable steps along the top."""
    figure, axes = panels(1, len(flows), (3.25, 3.2), sharex=True, sharey=True)
    for flow, axis in zip(flows, axes.flat):
        for name, colour, marker in (("etdrk4", TRUTH, "o"), ("rk4", MODEL, "s")):
            runs = stable_runs(flow, name)
            for quantity, style, face in (("density", "-", colour), ("spectrum", "--", "white")):
                axis.loglog([run["seconds"] for run in runs], [run[quantity] for run in runs], style, color=colour,
                            marker=marker, markersize=5, markerfacecolor=face,
                            label=f"{name.upper()}, {QUANTITIES[quantity]}")
            failed = [run["seconds"] for run in flow.runs if run["stepper"] == name and run["failed_at"] is not None]
            axis.plot(failed, [0.3] * len(failed), "x", color=colour, markersize=7)
        axis.set_title(f"$M_t = {flow.mach:g}$")
        number_wavenumbers(axis)
    axes[0, 0].set(ylabel="relative error  (× unstable)", ylim=(None, 1))
    axes[0, 1].set_xlabel("wall seconds per unit of time")
    letter(axes.flat)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=2)
    figure.savefig(path, dpi=100, facecolor="white", pil_kwargs={"optimize": True})


def table(flows):
    """What was found, as Markdown."""
    lines = ["| M_t | stepper | step | steps | of the stable limit | seconds per unit time | "
             + " | ".join(QUANTITIES.values()) + " |", "|---" * (6 + len(QUANTITIES)) + "|"]
    for flow in flows:
        for run in flow.runs:
            shown = [f"{run[quantity]:.2e}" for quantity in QUANTITIES] if run["failed_at"] is None else \
                [f"unstable at t = {run['failed_at']:.3g}"] * len(QUANTITIES)
            if run["reference"]:
                shown = ["reference"] * len(QUANTITIES)
            lines.append(f"| {flow.mach:g} | {run['stepper']} | {run['step']:.5f} | {run['steps']} "
                         f"| {run['part_of_limit']:.3g} | {run['seconds']:.3g} | {' | '.join(shown)} |")
    lines += ["", "Cost of RK4 over that of ETDRK4 at equal error:", "",
              f"| M_t | error of | {' | '.join(f'{error:.0e}' for error in TOLERANCES)} |",
              "|---" * (2 + len(TOLERANCES)) + "|"]
    for flow in flows:
        for quantity, ratios in flow.numbers["cost_of_rk4_over_etdrk4"].items():
            shown = " | ".join("" if ratio is None else f"{ratio:.3g}" for ratio in ratios.values())
            lines.append(f"| {flow.mach:g} | {QUANTITIES[quantity]} | {shown} |")
    return "\n".join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cells", type=int, default=48)
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    given, comm = parser.parse_args(), MPI.COMM_WORLD
    configure_logging(comm.rank)
    grid = SpectralGrid(SlabDecomposition(comm, 2 * np.pi, given.cells))
    flows, progress = list(developed_flows(grid)), ProgressLine("steppers", lambda: f"{given.cells} cells a side")
    for number, flow in enumerate(flows):
        study(flow, number, progress)
    measure_cost(flows)
    for flow in flows:
        conclude(flow)
    if comm.rank == 0:
        given.output.mkdir(parents=True, exist_ok=True)
        content = {"cells": given.cells, "ranks": comm.size, "duration": DURATION,
                   "flows": [{"mach": flow.mach, **flow.numbers, "runs": flow.runs} for flow in flows]}
        (given.output / "steppers.json").write_text(json.dumps(content, indent=1) + "\n")
        draw(flows, given.output / "steppers.png")
        print(table(flows))


if __name__ == "__main__":
    main()
