"""Time steppers of the direct simulation: their stability, their error against run time, and a known flow. A script.

    python tests/validation/steppers.py stability [--output runs/validation]                        # a minute
    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/steppers.py errors [--cells 48] [--output runs/validation]
    mpirun -n 2 .venv/bin/python -m mpi4py tests/validation/steppers.py taylor-green [--cells 64 128]

stability: how long a time step may be, measured and by theory. Measured are single waves in a uniform flow, by the
whole solver: each is an eigenvector of advection, sound and viscosity, so that a step multiplies it by the
amplification factor of the scheme for u' = L u + i a u; and the longest stable step of turbulence. Prints the numbers
and writes stability.png.

errors: developed turbulence decays for half a turnover at three Mach numbers, from the same state with each stepper,
with steps from beyond its limit of stability down. Errors at the end are relative to ETDRK4 with a fine step. Prints a
table and writes steppers.png. Takes minutes.

taylor-green: dissipation of the Taylor-Green vortex at Re = 1600 against 512^3 points (van Rees et al. 2011). Prints
the relative differences at the times of the reference, the peak, and the imbalance between the loss of energy and the
dissipation nu <|grad u|^2>. Takes minutes.
"""

import argparse
import math
import sys
import time
from pathlib import Path

import numpy as np
from flows import amplification, make_grid, march, measured_growth, turbulence, with_density
from mpi4py import MPI

from eddies.analysis.errors import normalized_l2
from eddies.clock import Clock
from eddies.flow import initial_fields
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import CompressibleFluid, IncompressibleFluid, advective_speed
from eddies.flow.stability import (
    IMAGINARY_REACH, REAL_REACH, CourantLimit, FlowDiverged, StabilityWatch, step_limits,
)
from eddies.flow.statistics import energy_spectrum, gradient_moments, incompressible_budget
from eddies.parallel.reduction import global_max
from eddies.report.figures import BLUE, GUIDE, MODEL, SECOND, THIRD, letter, panels, styled
from eddies.time_stepping import ETDRK4, STEPPERS

sys.path.append(str(Path(__file__).parents[2] / "docs"))

from pictures import save  # noqa: E402

TURBULENT_STEPS = 60
HIGHEST = 8.0  # of the advective numbers that are tried
ANY, PERCENT = 1e-6, 1e-2  # growths a step: as good as none; one that a little viscosity stops
NAMES = {"etdrk4": "ETDRK4", "rk4": "RK4"}
COLOURS = {("etdrk4", ANY): BLUE, ("etdrk4", PERCENT): SECOND, ("rk4", ANY): MODEL}

MACH_NUMBERS, DURATION, SKEWNESS = (0.04, 0.08, 0.16), 0.5, -0.4  # the start has developed at this skewness
# Steps in parts of the theoretical limit of stability; the shortest of ETDRK4 is the reference.
PARTS = {"rk4": (2.0, 0.95, 0.95 / 2, 0.95 / 4), "etdrk4": (2.0, 0.95, 0.95 / 2, 0.95 / 4, 0.95 / 8, 0.95 / 32)}
QUANTITIES = ("density", "spectrum", "velocity")

VISCOSITY, COURANT, LARGEST_STEP = 1 / 1600, 0.5, 1 / 32
# Published dissipation at these times, and the largest with its time.
REFERENCE = {1.0: 0.000519, 2.0: 0.000708, 3.0: 0.001127, 4.0: 0.002066, 5.0: 0.004127, 6.0: 0.005531}
PEAK_TIME, PEAK, FOLLOWED = 8.97, 0.012858, 10.0


def largest_speed(grid, state):
    return float(global_max(grid.decomposition.comm, advective_speed(grid, state[:3])))


# ---- stability


def theoretical_boundary(stepper, growth, viscosity=0.0, sound=0.0):
    """Smallest advective number at which a wave grows by more than `growth` a step; infinity if none does."""
    w = np.linspace(0, HIGHEST, 4001)
    factors = [np.abs(amplification(stepper, np.full(len(w), sign * 1j * sound - viscosity), w)) for sign in (1, -1)]
    growing = np.maximum(*factors) > 1 + growth
    return float(w[np.argmax(growing)]) if growing.any() else math.inf


def measured_boundary(comm, stepper, growth, **stiffness):
    """As the theoretical boundary: the first of the numbers 0, 0.1, 0.2 ... that grows, then bisection."""
    def grows(number):
        return measured_growth(comm, stepper, number, **stiffness) > 1 + growth

    high = next((number for number in np.arange(0, HIGHEST + 0.05, 0.1) if grows(number)), math.inf)
    if high in (0.0, math.inf):
        return high
    return bisect(lambda number: not grows(number), high - 0.1, high, 2e-3)


def bisect(good, low, high, width):
    """Where `good`, which holds at `low` and not at `high`, ends."""
    while high - low > width:
        middle = (low + high) / 2
        low, high = (middle, high) if good(middle) else (low, middle)
    return float(low + high) / 2


def boundary_of_turbulence(comm, stepper, mach):
    """Advective number step k_max max(|u| + |v| + |w|) of the longest step that random turbulence takes 60 times.

    Also the number of the theory, by `step_limits`.
    """
    fluid, state = turbulence(comm, 12, 0.02, math.sqrt(3) / mach)
    advance = STEPPERS[stepper](fluid)
    speed = largest_speed(fluid.grid, state)
    unit = fluid.grid.cutoff * speed
    theory = min(limit.boundary / limit.number for limit in step_limits(fluid, advance, 1 / unit, speed))

    def stable(number):
        watch, clock, now = StabilityWatch(fluid, advance, FlowHistory(fluid)), Clock(), state
        try:
            for _ in range(TURBULENT_STEPS):
                before, now = now, advance(now, number / unit)
                clock.tick(number / unit)
                watch(before, now, number / unit, clock)
        except FlowDiverged:
            return False
        return True

    exponent = bisect(lambda exponent: stable(theory * 2**exponent), -1.0, 4.0, 0.05)
    return {"stepper": stepper, "mach_turbulent": mach, "measured": theory * 2**exponent, "theory": theory}


def sweeps(comm):
    """Growth a step against the number of each limit."""
    ways = [("etdrk4", "advection"), ("rk4", "advection"), ("rk4", "sound"), ("rk4", "viscosity")]
    rows = []
    for stepper, limit in ways:
        for number in np.arange(0.2, 3.25, 0.2) + 0.05 * ways.index((stepper, limit)):
            numbers = {"advection": 0.0, limit: float(number)}
            z, w = complex(-numbers.get("viscosity", 0.0), numbers.get("sound", 0.0)), numbers["advection"]
            rows.append({"stepper": stepper, "limit": limit, "number": float(number),
                         "measured": measured_growth(comm, stepper, **numbers),
                         "theory": float(abs(amplification(stepper, z, w)))})
    return rows


def boundaries(comm, stiffness, ways):
    """Boundary of the advective number against a stiffness, for (stepper, growth) at some of its values."""
    return [{"stepper": stepper, "growth": growth, stiffness: float(value),
             "measured": measured_boundary(comm, stepper, growth, **{stiffness: float(value)}),
             "theory": theoretical_boundary(stepper, growth, **{stiffness: float(value)})}
            for (stepper, growth), values in ways.items() for value in values]


@styled
def draw_stability(results, path):
    """Growth against the step; boundaries with viscosity, with sound, and of turbulence."""
    figure, axes = panels(2, 2, (4.5, 3.5))
    growth_panel(axes[0, 0], results["sweeps"])
    boundary_panel(axes[0, 1], results["with_viscosity"], "viscosity", np.linspace(0, 10, 201), (0, HIGHEST))
    axes[0, 1].set(title="with viscosity", xlabel=r"step $\times\ \nu k^2$")
    boundary_panel(axes[1, 0], results["with_sound"], "sound", np.linspace(0, 12, 241), (0, 4.5))
    axes[1, 0].set(title="with sound", xlabel=r"step $\times\ c k$")
    turbulence_panel(axes[1, 1], results["turbulence"])
    letter(axes.ravel())
    save(path, figure)


def growth_panel(axis, rows):
    """Growth a step against the number of the limit."""
    number = np.linspace(0, 3.4, 200)
    axis.axhline(1, color=GUIDE, linewidth=0.8)
    for factor in (amplification("rk4", 0 * number, number), amplification("rk4", -number, 0 * number)):
        axis.plot(number, np.abs(factor), color=GUIDE)
    for (stepper, limit), marker, colour in zip([("etdrk4", "advection"), ("rk4", "advection"), ("rk4", "sound"),
                                                 ("rk4", "viscosity")], "os^v", (BLUE, MODEL, THIRD, SECOND)):
        own = [row for row in rows if (row["stepper"], row["limit"]) == (stepper, limit)]
        axis.plot([row["number"] for row in own], [row["measured"] for row in own], marker, markersize=4,
                  color=colour, label=f"{NAMES[stepper]}, {limit}")
    for reach in (IMAGINARY_REACH, REAL_REACH):
        axis.axvline(reach, color=GUIDE, linestyle=":", linewidth=1)
    axis.set(title="one limit alone; points: measured, lines: theory", xlabel="number of the step",
             ylabel="growth a step", ylim=(0, 2))
    axis.legend(loc="upper left")


def boundary_panel(axis, rows, stiffness, values, limits):
    """Largest advective number: theory as lines, measured as points; where nothing grows there is neither."""
    for (stepper, growth), colour in COLOURS.items():
        own = [row for row in rows if (row["stepper"], row["growth"]) == (stepper, growth)]
        if not own:
            continue
        theory = [theoretical_boundary(stepper, growth, **{stiffness: value}) for value in values]
        name = NAMES[stepper] + (", growth of 1 %" if growth == PERCENT else ", any growth")
        axis.plot(values, theory, color=colour, linewidth=1.2)
        axis.plot([row[stiffness] for row in own], [row["measured"] for row in own], "o", markersize=4, color=colour,
                  label=name, clip_on=False)
    axis.set(ylabel=r"step $\times\ k\,U$", xlim=(0, values[-1]), ylim=limits)
    axis.legend(loc="upper left", bbox_to_anchor=(0.15, 1))


def turbulence_panel(axis, rows):
    """Longest step of turbulence against the Mach number."""
    for stepper, colour in (("etdrk4", BLUE), ("rk4", MODEL)):
        own = [row for row in rows if row["stepper"] == stepper]
        mach = [row["mach_turbulent"] for row in own]
        axis.loglog(mach, [row["theory"] for row in own], color=colour, linewidth=1.2)
        axis.loglog(mach, [row["measured"] for row in own], "o", markersize=4, color=colour, label=NAMES[stepper])
    axis.set(title="turbulence, longest stable step", xlabel=r"$M_t$",
             ylabel=r"step $\times\ k_{max}\,\max(|u|+|v|+|w|)$")
    axis.legend(loc="lower right")


def stability(comm, output):
    slow, leak = [0, 0.5, 1, 2, 3, 4, 5, 6, 7, 8], [0.5, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    with np.errstate(all="ignore"):
        results = {
            "sweeps": sweeps(comm),
            "with_viscosity": boundaries(comm, "viscosity", {("etdrk4", ANY): slow, ("rk4", ANY): [0, 0.5, 1, 2, 2.5]}),
            "with_sound": boundaries(comm, "sound", {
                ("etdrk4", ANY): leak, ("etdrk4", PERCENT): leak, ("rk4", ANY): [0.5, 1, 1.5, 2, 2.5]}),
            "turbulence": [boundary_of_turbulence(comm, stepper, mach) for stepper in STEPPERS
                           for mach in (0.01, 0.04, 0.16, 0.5)]}
    if comm.rank == 0:
        draw_stability(results, output / "stability.png")
        for name, rows in results.items():
            print(name, *("  " + "  ".join(f"{key} {value:.5g}" if isinstance(value, float) else f"{value}"
                                           for key, value in row.items()) for row in rows), sep="\n")


# ---- errors


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
def draw_errors(found, path):
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
    save(path, figure)


def errors_of_steps(comm, cells, output):
    with np.errstate(over="ignore", invalid="ignore"):
        found = {mach: study(fluid, start) for mach, fluid, start in developed_flows(make_grid(comm, cells))}
    if comm.rank == 0:
        draw_errors(found, output / "steppers.png")
        for mach, runs in found.items():
            for run in runs:
                shown = [f"{quantity} {run[quantity]:.2e}" for quantity in QUANTITIES if quantity in run]
                print(f"M_t {mach:g}  {run['stepper']:6}  step {run['step']:.5f}  {run['seconds']:.3g} s  ",
                      *(shown or ["unstable"]))


# ---- the Taylor-Green vortex


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


def taylor_green(comm, cells):
    times, energy, dissipation = simulate(comm, cells, FOLLOWED)
    differences = [f"t = {moment:g}: {np.interp(moment, times, dissipation) / true - 1:+.2%}"
                   for moment, true in REFERENCE.items() if moment <= times[-1]]
    highest = np.argmax(dissipation)
    lost = energy[0] - energy
    dissipated = np.concatenate([[0], np.cumsum(np.diff(times) * (dissipation[1:] + dissipation[:-1]) / 2)])
    if comm.rank == 0:
        print(f"{cells}^3:", ", ".join(differences), f"; peak {dissipation[highest] / PEAK - 1:+.2%} at t = "
              f"{times[highest]:.2f} (reference {PEAK_TIME}); imbalance of energy "
              f"{np.max(np.abs(lost - dissipated)) / lost[-1]:.1e}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("stability", "errors", "taylor-green"))
    parser.add_argument("--cells", type=int, nargs="+")
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    given, comm = parser.parse_args(), MPI.COMM_WORLD
    given.output.mkdir(parents=True, exist_ok=True)
    if given.what == "stability":
        stability(comm, given.output)
    for cells in given.cells or {"stability": [], "errors": [48], "taylor-green": [64, 128]}[given.what]:
        errors_of_steps(comm, cells, given.output) if given.what == "errors" else taylor_green(comm, cells)


if __name__ == "__main__":
    main()
