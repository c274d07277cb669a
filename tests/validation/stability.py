"""How long a time step may be, measured and by theory. A script, about a minute long.

    python tests/validation/stability.py [--output runs/validation]

Measured are single waves in a uniform flow, by the whole solver: each is an eigenvector of advection, sound and
viscosity, so that a step multiplies it by the amplification factor of the scheme for u' = L u + i a u; and the longest
stable step of turbulence. Prints the numbers and writes stability.png.
"""

import argparse
import math
from pathlib import Path

import numpy as np
from flows import amplification, measured_growth, turbulence
from mpi4py import MPI
from PIL import Image

from eddies.clock import Clock
from eddies.flow.history import FlowHistory
from eddies.flow.navier_stokes import advective_speed
from eddies.flow.stability import IMAGINARY_REACH, REAL_REACH, FlowDiverged, StabilityWatch, step_limits
from eddies.parallel.reduction import global_max
from eddies.report.figures import BLUE, GUIDE, MODEL, SECOND, THIRD, letter, panels, styled
from eddies.time_stepping import STEPPERS

TURBULENT_STEPS = 60
HIGHEST = 8.0  # of the advective numbers that are tried
ANY, PERCENT = 1e-6, 1e-2  # growths a step: as good as none; one that a little viscosity stops
NAMES = {"etdrk4": "ETDRK4", "rk4": "RK4"}
COLOURS = {("etdrk4", ANY): BLUE, ("etdrk4", PERCENT): SECOND, ("rk4", ANY): MODEL}


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
    speed = float(global_max(comm, advective_speed(fluid.grid, state[:3])))
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
def draw(results, path):
    """Growth against the step; boundaries with viscosity, with sound, and of turbulence."""
    figure, axes = panels(2, 2, (4.5, 3.5))
    growth_panel(axes[0, 0], results["sweeps"])
    boundary_panel(axes[0, 1], results["with_viscosity"], "viscosity", np.linspace(0, 10, 201), (0, HIGHEST))
    axes[0, 1].set(title="with viscosity", xlabel=r"step $\times\ \nu k^2$")
    boundary_panel(axes[1, 0], results["with_sound"], "sound", np.linspace(0, 12, 241), (0, 4.5))
    axes[1, 0].set(title="with sound", xlabel=r"step $\times\ c k$")
    turbulence_panel(axes[1, 1], results["turbulence"])
    letter(axes.ravel())
    figure.savefig(path, dpi=100, facecolor="white")
    Image.open(path).convert("RGB").quantize(64).save(path, optimize=True)


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


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--output", type=Path, default=Path("runs/validation"))
    output, comm = parser.parse_args().output, MPI.COMM_WORLD
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
        output.mkdir(parents=True, exist_ok=True)
        draw(results, output / "stability.png")
        for name, rows in results.items():
            print(name, *("  " + "  ".join(f"{key} {value:.5g}" if isinstance(value, float) else f"{value}"
                                           for key, value in row.items()) for row in rows), sep="\n")


if __name__ == "__main__":
    main()
