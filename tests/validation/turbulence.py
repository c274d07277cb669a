"""Flows and rollouts beside data of the literature, as Markdown tables. A script.

    python tests/validation/turbulence.py mach runs/hit=0.08 RUN=M_T ... [--output runs/validation]
    python tests/validation/turbulence.py spectra "hit=runs/hit,runs/hit-2" hit-256=runs/paper-256
    mpirun -n 2 .venv/bin/eddies dns tests/validation/wray.toml
    python tests/validation/turbulence.py decay runs/wray
    mpirun -n 2 .venv/bin/eddies run cbc
    python tests/validation/turbulence.py grid runs/cbc [--output docs/validation]

mach: stationary turbulence at several turbulent Mach numbers, each run with its nominal M_t, and its scaling with M_t.
The scenes have [spin_up] stationary (hit, hit-mt004, hit-mt008, hit-mt016). Writes turbulence.png, too.

spectra: mean spectra of stationary flows beside that of the isotropic data set of Johns Hopkins. Runs of one name are
averaged, with the standard deviation over them. The table has eps^(-2/3) k^(5/3) E(k) at several k eta. Spectra of
different Reynolds numbers collapse in the dissipation range, from k eta = 0.1 on.

decay: decaying isotropic turbulence beside a direct simulation of 512^3 cells. The run starts from the spectrum of the
reference at t = 2.977 with random phases. Its transfer of energy needs about one unit of time to recover, so the
comparison begins at t = 4. The table has energy, enstrophy, skewness and the exponent n of the decay, E ~ (t - t_0)^-n.

grid: decaying grid turbulence beside the experiment of Comte-Bellot and Corrsin. The flows start from the spectrum
measured at t U0/M = 42. The truth at 98 and 171 is the measured spectrum, filtered as the particles' velocity is. For
each variant docs/results/cbc.json has the energy up to k_d over that of the filtered experiment and the rms of
ln(E/E_experiment), means and standard deviations over the realisations; docs/tables.py writes the table. Draws
grid-turbulence.png with the spectra.
"""

import argparse
import json
import sys
from itertools import cycle
from pathlib import Path

import numpy as np
from matplotlib import rc_context
from matplotlib.figure import Figure
from mpi4py import MPI

from eddies.analysis.isotropic_turbulence import Row, StationarySpan, comparison
from eddies.io.hdf5 import open_product, read_table
from eddies.report.figures import (
    BLUE, DNS, GUIDE, MODEL, SECOND, THIRD, TRUTH, legend_at_foot, letter, looks, number_wavenumbers, panels, styled,
)
from eddies.report.page import shown
from eddies.report.stationary import draw_compensated
from eddies.spectral.mode_operators import gaussian_transfer
from eddies.stored_run import open_run
from eddies.workflows.ground_truth.stationary import read_stationary_span

DOCS = Path(__file__).parents[2] / "docs"
sys.path.append(str(DOCS))

from pictures import save  # noqa: E402

NOMINAL = (0.04, 0.08, 0.16)  # turbulent Mach numbers of the paper's Table 1
MEASURED, STEPS = 0.05, 0.1  # how far M_t and the steps per turnover may be off
COLOURS = (BLUE, MODEL, SECOND, THIRD, DNS)
SCALED = {"density_rms": (r"$\rho_{rms}/\rho_0$", BLUE, "o"), "compressible_velocity": (r"$\sqrt{\chi}$", MODEL, "s")}
# Johns Hopkins Turbulence Databases, isotropic1024coarse, Re_lambda 417 to 433 (Li et al., J. Turbulence 9, N31, 2008;
# Perlman et al. 2007): k eta and the compensated spectrum, with nu = 1.85e-4, eps = 0.1031 and eta = 0.0028.
JOHNS_HOPKINS = {0.02: 1.59, 0.05: 1.77, 0.1: 2.08, 0.126: 2.17, 0.2: 1.90, 0.5: 0.522, 1.0: 0.0533}
# A. A. Wray (1997), case HOM02 of AGARD Advisory Report 345, nu = 3.5014e-4: energy, enstrophy <omega^2> and skewness
# of the longitudinal velocity gradient over time.
VISCOSITY, START = 3.5014e-4, 2.977
TIMES = (3.992, 5.028, 5.719)
REFERENCE = {"energy": (0.06924, 0.05027, 0.04223), "enstrophy": (70.20, 38.82, 28.40),
             "skewness": (-0.514, -0.515, -0.517)}

# G. Comte-Bellot, S. Corrsin, J. Fluid Mech. 48, 273 (1971), Table 3: k (1/cm) and E (cm^3/s^2) at t U0/M = 98 and 171,
# behind a grid of mesh M = 5.08 cm in a wind of U0 = 10 m/s.
WAVENUMBER = (0.11, 0.15, 0.20, 0.25, 0.30, 0.40, 0.50, 0.70, 1.00, 1.50, 2.00, 2.50, 3.00, 4.00)
ENERGY = {98: (25, 55, 106, 196, 195, 202, 168, 127, 79.2, 47.8, 34.6, 28.6, 23.1, 14.3),
          171: (20, 49.7, 92.0, 120, 125, 98.0, 81.5, 60.2, 39.4, 24.1, 16.5, 12.5, 9.12, 5.62)}
LENGTH, SPEED, MESH, WIND = 11 * 5.08 / (2 * np.pi), 22.2, 5.08, 1000.0  # units of the scene; cm and cm/s
GRID_STYLES = ("--", ":", "-.", (0, (6, 1, 1, 1, 1, 1)), (0, (8, 3)))  # of the lines of grids


def read(directory: Path, reader):
    """What a function reads from the ground truth of a run."""
    with open_product(MPI.COMM_SELF, directory / "ground_truth.h5", "ground_truth") as file:
        return reader(file)


class Run:
    """The stationary state of one run, by name."""

    def __init__(self, given: str) -> None:
        directory, _, mach = given.partition("=")
        path, self.nominal = Path(directory), float(mach)
        self.name = path.resolve().name
        self.span = read(path, read_stationary_span)
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


def table_of_runs(runs: list[Run]) -> str:
    """The rows of all runs, side by side, as Markdown."""
    lines = [f"| quantity | {' | '.join(run.name for run in runs)} | literature | source |",
             "|" + "---|" * (len(runs) + 3),
             f"| nominal M_t | {' | '.join(str(run.nominal) for run in runs)} | | |"]
    for key, row in runs[0].rows.items():
        found = [run.rows.get(key) for run in runs]
        literature = dict.fromkeys(brief(other.literature) for other in found if other and other.literature is not None)
        lines.append(f"| {row.label} | {' | '.join(map(row_cell, found))} | {', '.join(literature)} | {row.source} |")
    return "\n".join(lines)


def row_cell(row: Row | None) -> str:
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


# ---- spectra


def compensated_at(span: StationarySpan, wavenumbers: np.ndarray) -> np.ndarray:
    """The compensated spectrum at some k eta, interpolated in logarithms; NaN outside the unforced shells."""
    k_eta, values = span.unforced()
    return np.exp(np.interp(np.log(wavenumbers), np.log(k_eta), np.log(values), left=np.nan, right=np.nan))


def cell(values: np.ndarray) -> str:
    """Mean with the standard deviation over runs; empty without values."""
    if np.isnan(values).any():
        return ""
    return f"{values.mean():.3g}" + (f" ± {values.std(ddof=1):.1g}" if len(values) > 1 else "")


def table_of_spectra(groups: dict[str, list[StationarySpan]]) -> str:
    """The rows of all k eta, and of the Reynolds numbers, as Markdown."""
    wavenumbers = np.array([*JOHNS_HOPKINS])
    found = {name: np.array([compensated_at(span, wavenumbers) for span in spans]) for name, spans in groups.items()}
    reynolds = [cell(np.array([span.mean("reynolds_lambda") for span in spans])) for spans in groups.values()]
    lines = [f"| kη | Johns Hopkins | {' | '.join(groups)} |", "|---|---|" + "---|" * len(groups),
             f"| Re_λ | 417 to 433 | {' | '.join(reynolds)} |"]
    for row, (k_eta, reference) in enumerate(JOHNS_HOPKINS.items()):
        cells = " | ".join(cell(each[:, row]) for each in found.values())
        lines.append(f"| {k_eta:g} | {reference:g} | {cells} |")
    return "\n".join(lines)


# ---- decay


def exponent(time: np.ndarray, energy: np.ndarray, enstrophy: np.ndarray) -> float:
    """1/(d(E/eps)/dt) by least squares; E/eps = (t - t_0)/n where the energy decays with a power of time."""
    return float(1 / np.polyfit(time, energy / (VISCOSITY * enstrophy), 1)[0])


def table_of_decay(columns: dict[str, np.ndarray]) -> str:
    """The rows of a run beside the reference, as Markdown."""
    time = START + columns["time"]
    own = {"energy": columns["energy"], "enstrophy": columns["dissipation_rate"] / VISCOSITY,
           "skewness": columns["skewness"]}
    lines = ["| | t | 512³ cells | here |", "|---|---|---|---|"]
    for name, published in REFERENCE.items():
        for moment, value in zip(TIMES, published):
            lines.append(f"| {name} | {moment:g} | {value:.4g} | {np.interp(moment, time, own[name]):.4g} |")
    late = (time > TIMES[0]) & (time < TIMES[-1])
    energy, enstrophy = (np.array(REFERENCE[name]) for name in ("energy", "enstrophy"))
    lines.append(f"| exponent of the decay | {TIMES[0]:g} to {TIMES[-1]:g} | "
                 f"{exponent(np.array(TIMES), energy, enstrophy):.3g} | "
                 f"{exponent(time[late], own['energy'][late], own['enstrophy'][late]):.3g} |")
    resolution = np.interp(TIMES[0], time, columns["kmax_eta"]), columns["kmax_eta"][-1]
    lines.append(f"| resolution k_max η | {TIMES[0]:g}, end | | {resolution[0]:.2f}, {resolution[1]:.2f} |")
    return "\n".join(lines)


# ---- grid turbulence


def filtered_experiment(station: int, shells: np.ndarray, filter_width: float) -> np.ndarray:
    """E(k) of the filtered experiment in units of the scene."""
    logarithm = np.interp(np.log(shells), np.log(np.array(WAVENUMBER) * LENGTH), np.log(ENERGY[station]))
    return np.exp(logarithm) / (SPEED**2 * LENGTH) * gaussian_transfer(shells**2, filter_width) ** 2


def time_of(station: int) -> float:
    """Time since the first station in units of the scene."""
    return (station - 42) * MESH / WIND / (LENGTH / SPEED)


def rollout_spectra(directory: Path, variant: str, realisations: tuple[int, ...], station: int,
                    shells: np.ndarray) -> np.ndarray:
    """E(k) (realisations, shells) of the rollouts at a station; ln E is linear in time between two frames."""
    found = []
    for seed in realisations:
        path = directory / variant / f"realisation-{seed}"
        with open_product(MPI.COMM_SELF, path / "rollout.h5", "rollout") as file:
            time = time_of(station) - file["rollout"].attrs["start_time"]  # stored times count from the start
        spectra = open_run(path)["rollout/spectra_of_model"]
        place = np.interp(time, spectra["time"], np.arange(len(spectra["time"])))
        before, after = (np.log(spectra["energy"][int(place) + later].values[shells.astype(int)]) for later in (0, 1))
        found.append(np.exp(before + place % 1 * (after - before)))
    return np.array(found)


def row_of(name: str, spectra: dict[int, np.ndarray], shells: np.ndarray,
           filter_width: float) -> dict[str, str | float]:
    """A row of the table: means and standard deviations over the realisations."""
    numbers: dict[str, np.ndarray] = {}
    for station, spectrum in spectra.items():
        truth = filtered_experiment(station, shells, filter_width)
        numbers |= {f"energy_{station}_ratio": spectrum.sum(1) / truth.sum(),
                    f"rms_{station}": np.sqrt(np.mean(np.log(spectrum / truth) ** 2, axis=1))}
    return {"name": name, **{key: float(each.mean()) for key, each in numbers.items()},
            **{f"{key}_spread": float(each.std(ddof=1)) for key, each in numbers.items()}}


@styled
def draw_grid(found: dict[str, dict[int, np.ndarray]], grids: set[str], shells: np.ndarray,
              filter_width: float) -> Figure:
    """Mean spectra of all variants at both stations, with the filtered experiment; dashed: those of grids."""
    figure, axes = panels(1, 2, (4.2, 3.4))
    order = sorted(found, key=lambda name: name in grids)  # grids last
    models = looks({name: ["none" if name == "no-force" else name] for name in order if name not in grids}, {})
    lines = {name: {"color": colour, "linestyle": "-"} for name, (colour, _) in models.items()}
    lines |= {name: {"color": BLUE, "linestyle": style} for name, style in zip(sorted(grids), GRID_STYLES)}
    for axis, station in zip(axes.flat, ENERGY):
        axis.loglog(shells, filtered_experiment(station, shells, filter_width), "o", color=TRUTH, label="experiment")
        for name in order:
            axis.loglog(shells, found[name][station].mean(0), **lines[name], label=name)
        axis.set(title=f"$t U_0/M = {station}$", xlabel="$k$", ylabel="$E(k)$")
        number_wavenumbers(axis)
    with rc_context({"legend.handlelength": 4}):  # a whole pattern of dashes
        legend_at_foot(figure, axes.flat[0])
    letter(axes.flat)
    return figure


def compare_with_grid_turbulence(run: Path, output: Path) -> None:
    """Store the rows of a run of the scene `cbc` for the tables of docs, and draw the spectra."""
    scene = open_run(run).scene
    filter_width = scene.tracers.filter_width
    shells = np.arange(1.0, np.pi / filter_width + 0.5)
    found = {name: {station: rollout_spectra(run, name, scene.realisations, station, shells) for station in ENERGY}
             for name in scene.variant}
    rows = [row_of(name, spectra, shells, filter_width) for name, spectra in found.items()]
    (DOCS / "results" / "cbc.json").write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")
    grids = {name for name, variant in scene.variant.items() if variant.simulation.form.on_grid}
    save(output / "grid-turbulence.png", draw_grid(found, grids, shells, filter_width))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", choices=("mach", "spectra", "decay", "grid"))
    parser.add_argument("runs", nargs="+", metavar="RUN", help="RUN=M_T, NAME=RUN,RUN or a run directory")
    parser.add_argument("--output", default=Path("runs/validation"), type=Path, metavar="DIR")
    options = parser.parse_args()
    options.output.mkdir(parents=True, exist_ok=True)
    if options.what == "grid":
        compare_with_grid_turbulence(Path(options.runs[0]), options.output)
    elif options.what == "decay":
        print(table_of_decay(read(Path(options.runs[0]), lambda file: read_table(file, "statistics"))))
    elif options.what == "spectra":
        groups = dict(argument.split("=", 1) for argument in options.runs)
        print(table_of_spectra({name: [read(Path(path), read_stationary_span) for path in paths.split(",")]
                                for name, paths in groups.items()}))
    else:
        runs = [Run(directory) for directory in options.runs]
        save(options.output / "turbulence.png", draw(runs))
        print(table_of_runs(runs))
        if len({run.nominal for run in runs}) > 1:
            for name, value in scaling(runs).items():
                print(f"{name}: {shown(value)}")


if __name__ == "__main__":
    main()
