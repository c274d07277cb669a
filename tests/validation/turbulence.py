"""Stationary turbulence at several turbulent Mach numbers against the literature, and its scaling with M_t. A script.

    python tests/validation/turbulence.py runs/hit=0.08 RUN=M_T ... [--output runs/validation]

Reads the ground_truth.h5 of runs, each with its nominal M_t, whose scenes have [spin_up] stationary (hit, hit-mt004,
hit-mt008, hit-mt016), prints a table of their averages beside the literature's values, and writes turbulence.png.
"""

import argparse
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from mpi4py import MPI

from eddies.analysis.isotropic_turbulence import Row, comparison
from eddies.io.hdf5 import open_product
from eddies.report.figures import BLUE, DNS, GUIDE, MODEL, SECOND, THIRD, letter, panels, styled
from eddies.report.page import shown
from eddies.report.stationary import draw_compensated
from eddies.workflows.ground_truth.stationary import read_stationary_span

NOMINAL = (0.04, 0.08, 0.16)  # turbulent Mach numbers of the paper's Table 1
MEASURED, STEPS = 0.05, 0.1  # how far M_t and the steps per turnover may be off
COLOURS = (BLUE, MODEL, SECOND, THIRD, DNS)
SCALED = {"density_rms": (r"$\rho_{rms}/\rho_0$", BLUE, "o"), "compressible_velocity": (r"$\sqrt{\chi}$", MODEL, "s")}


class Run:
    """The stationary state of one run, by name."""

    def __init__(self, given: str) -> None:
        directory, _, mach = given.partition("=")
        path, self.nominal = Path(directory), float(mach)
        self.name = path.resolve().name
        with open_product(MPI.COMM_SELF, path / "ground_truth.h5", "ground_truth") as file:
            self.span = read_stationary_span(file)
        if "mach_turbulent" not in self.span.columns:
            raise SystemExit(f"{path}: an incompressible fluid has no Mach number; give runs of compressible ones")
        self.rows: dict[str, Row] = {row.key: row for row in comparison(self.span)}
        self.mach = self.span.mean("mach_turbulent")
        self.density_rms = self.span.mean("density_rms")
        self.compressible_fraction = self.span.mean("compressible_fraction")
        self.compressible_velocity = np.sqrt(self.compressible_fraction)


def scaling(runs: list[Run]) -> dict[str, float]:
    """Exponents of M_t, and how much the steps per turnover differ, over runs of at least two Mach numbers."""
    mach = np.log([run.mach for run in runs])
    steps = [run.span.steps_per_turnover for run in runs]
    exponents = {f"{name}_exponent": float(np.polyfit(mach, np.log([getattr(run, name) for run in runs]), 1)[0])
                 for name in ("density_rms", "compressible_velocity", "compressible_fraction")}
    return {**exponents, "steps_per_turnover_spread": max(steps) / min(steps) - 1,
            "largest_mach_deviation": max(abs(run.mach / run.nominal - 1) for run in runs)}


def table(runs: list[Run]) -> str:
    """The rows of all runs, side by side, as Markdown."""
    lines = [f"| quantity | {' | '.join(run.name for run in runs)} | literature | source |",
             "|" + "---|" * (len(runs) + 3),
             f"| nominal M_t | {' | '.join(str(run.nominal) for run in runs)} | | |"]
    for key, row in runs[0].rows.items():
        found = [run.rows.get(key) for run in runs]
        literature = dict.fromkeys(brief(other.literature) for other in found if other and other.literature is not None)
        lines.append(f"| {row.label} | {' | '.join(map(cell, found))} | {', '.join(literature)} | {row.source} |")
    return "\n".join(lines)


def cell(row: Row | None) -> str:
    """A value with its deviation."""
    if row is None:
        return ""
    return brief(row.value) + (f" ± {row.deviation:.1g}" if row.deviation is not None else "")


def brief(value: float | str) -> str:
    """Three digits of a number."""
    return f"{value:.3g}" if isinstance(value, float) else value


@styled
def draw(runs: list[Run]) -> Figure:
    """Compensated spectra, M_t, density and compressible velocity against M_t, steps per turnover."""
    figure, axes = panels(2, 2, (4.2, 3.1))
    spectra, measured, scaled, steps = axes.flat
    draw_compensated(spectra, {run.name: (run.span, colour) for run, colour in zip(runs, cycle(COLOURS))})
    mach = np.array([run.mach for run in runs])
    for limit in (1 - MEASURED, 1 + MEASURED):
        measured.axhline(limit, color=GUIDE, linestyle=":", linewidth=1)
    deviations = [run.rows["mach_turbulent"].deviation / run.nominal for run in runs]
    measured.errorbar([run.nominal for run in runs], [run.mach / run.nominal for run in runs], deviations, fmt="o",
                      color=BLUE, capsize=3)
    measured.set(title="Turbulent Mach number", xlabel="nominal $M_t$", ylabel="measured / nominal", xscale="log")
    measured.margins(y=0.3)
    reach = np.array([mach.min() / 1.2, mach.max() * 1.2])
    for name, (label, colour, marker) in SCALED.items():
        values = np.array([getattr(run, name) for run in runs])
        scaled.loglog(mach, values, marker, color=colour, label=label)
        level = np.exp(np.mean(np.log(values / mach**2)))
        scaled.loglog(reach, level * reach**2, "--", color=GUIDE, linewidth=1.1)
    scaled.plot([], [], "--", color=GUIDE, linewidth=1.1, label="$M_t^2$")
    scaled.set(title="Compressibility", xlabel="$M_t$", ylabel="fraction")
    scaled.legend()
    counts = np.array([run.span.steps_per_turnover for run in runs])
    for limit in (1 - STEPS / 2, 1 + STEPS / 2):
        steps.axhline(limit * counts.mean(), color=GUIDE, linestyle=":", linewidth=1)
    steps.plot(mach, counts, "o", color=BLUE)
    steps.set(title="Cost", xlabel="$M_t$", ylabel="steps per turnover", xscale="log",
              ylim=(0, 1.3 * counts.max()))
    for axis in (measured, scaled, steps):
        axis.set_xticks(NOMINAL, map(str, NOMINAL))
        axis.set_xticks([], minor=True)
        axis.set_xlim(0.03, 0.22)
    letter(axes.flat)
    return figure


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("runs", nargs="+", metavar="RUN=M_T", help="run directory and its nominal M_t")
    parser.add_argument("--output", default="runs/validation", metavar="DIR")
    options = parser.parse_args()
    runs, output = [Run(directory) for directory in options.runs], Path(options.output)
    output.mkdir(parents=True, exist_ok=True)
    draw(runs).savefig(output / "turbulence.png", dpi=100, facecolor="white")
    print(table(runs))
    if len({run.nominal for run in runs}) > 1:
        for name, value in scaling(runs).items():
            print(f"{name}: {shown(value)}")


if __name__ == "__main__":
    main()
